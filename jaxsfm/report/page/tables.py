"""What the page says in words and tables."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.report.finished_run import KeptRun
from jaxsfm.report.page.embedded import embed
from jaxsfm.report.page.figures import count, figures3
from jaxsfm.report.page.pair_states import NOT_TRUSTED, NOT_VERIFIED, STATES, USED, state
from jaxsfm.report.summary import MAX_GROUPS, named

MAX_PHOTOS, MAX_PAIRS = 60, 15
"""Rows of a table; the rest is counted."""
THUMBNAIL = 96
MAX_NAMES = 8
"""Photos named of a group."""

ADVICE = {
    "pairs": "name pairs with it in the --pairs file, or leave that option out",
    "too few matches": "try --preset robust, or a larger --max-size; is it of the same scene?",
    "no plane": "try --preset robust; the scene may show no surface that both photos share",
    "not connected": "take photos between it and the others, or look at the refused pairs",
    "no pose": "take more photos near it; known --intrinsics help too",
    "not confirmed": "is it of the same place? if it is, take photos between it and the others",
    "other model": "is it of the same place? if it is, take photos between it and the others",
}
"""What may help an image lost at a stage, for runs of versions that did not record it."""


class Fact(NamedTuple):
    """A number of the verdict."""

    label: str
    value: str
    note: str = ""


class Verdict(NamedTuple):
    """The answer in a few lines."""

    level: str
    """good, partial or none."""
    headline: str
    sentences: list[str]
    facts: list[Fact]


def duration(seconds: float) -> str:
    """In the two largest units."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def verdict(report: Mapping[str, Any]) -> Verdict:
    """What came of the run."""
    usable, models = report["images"]["usable"], report["models"]
    facts = [Fact("time", duration(sum(report["seconds"].values())), "all stages of this call")]
    if not models:
        return Verdict(
            "none",
            "No model could be built.",
            [
                f"{reason[0].upper()}{reason[1:]}." if (reason := report.get("no_model")) else "",
                "Below: what became of each pair, and of each photo.",
            ],
            [Fact("photos in the model", f"0 of {usable}"), *facts],
        )
    best = models[0]
    whole = best["registered"] == usable
    px = best["reprojection_error_px"]
    sentences = [
        f"The model explains what the photos show to {px:.2f} px on average. "
        "A small value is needed for a good model, but does not prove it."
    ]
    figures = [
        Fact("photos in the model", f"{best['registered']} of {usable}"),
        Fact("reprojection error", f"{px:.2f} px", "mean"),
        Fact("3-D points", count(best["points"]), f"seen {best['track_length']:.1f} times"),
    ]
    evaluation = report.get("evaluation")
    if evaluation:
        position, rotation = evaluation["position"], evaluation["rotation_deg"]
        mean, most = (
            f"{figures3(position[k])} of its units and {figures3(rotation[k])} deg"
            for k in ("mean", "max")
        )
        sentences.append(
            f"Against the reference the cameras are off by {mean} on average, {most} at most."
        )
        figures += [
            Fact("position error", figures3(position["mean"]), "mean, units of the reference"),
            Fact("rotation error", f"{figures3(rotation['mean'])}\u00b0", "mean"),
        ]
    else:
        sentences.append(
            report.get("evaluation_failed", "")
            or "There are no reference poses to compare with: look at the 3-D model and at the "
            "refused pairs to judge it."
        )
    if len(models) > 1 and not whole:
        others = len(models) - 1
        sentences.append(f"{others} smaller model{'s' * (others > 1)} could not be joined to it.")
    headline = (
        f"All {usable} photos are in one model."
        if whole
        else f"{best['registered']} of {usable} photos are in one model; "
        f"{usable - best['registered']} are lost."
    )
    return Verdict("good" if whole else "partial", headline, sentences, [*figures, *facts])


def pair_table(rows: Sequence[Any]) -> dict[str, Any]:
    """The strongest refused pairs with the reasons, and how many there are of each state."""
    refused = [row for row in rows if state(row) in (NOT_TRUSTED, NOT_VERIFIED)]
    refused.sort(key=lambda row: (-row["colmap_inliers"], -row["inliers"], row["pair"]))
    states = np.bincount([state(row) for row in rows], minlength=len(STATES)).tolist()
    return {
        "counts": [(s, n) for s, n in zip(STATES, states, strict=True) if n],
        "refused": [
            {
                **row,
                "state": STATES[state(row)].name,
                "reason": (row["view_graph"] or {}).get("reason") or STATES[state(row)].meaning,
            }
            for row in refused[:MAX_PAIRS]
        ],
        "left_out": max(0, len(refused) - MAX_PAIRS),
    }


def component_table(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The groups of photos that trusted pairs join, the largest first; none where they are one."""
    groups = report.get("view_graph", {}).get("components", [])
    several = [group for group in groups if len(group["images"]) > 1]
    if len(groups) < 2:
        return []
    return [{**group, "names": named(group["images"], MAX_NAMES)} for group in several[:MAX_GROUPS]]


def advice(lost: Mapping[str, Any]) -> str | None:
    """What may help a lost photo, in a line."""
    if "help" not in lost:
        return ADVICE.get(lost["stage"])
    return "; ".join(
        f"{each['option']} ({each['reason']})" if each["option"] else each["reason"]
        for each in lost["help"]
    )


def _observations(run: KeptRun) -> dict[str, tuple[int, float]]:
    """Name -> number and mean reprojection error of a view's observations."""
    if run.model is None:
        return {}
    tracks, errors = run.model.tracks, run.model.errors
    n = len(run.model.views)
    number = np.bincount(tracks.view, minlength=n)
    total = np.bincount(tracks.view, weights=errors, minlength=n)
    return {
        view.name: (int(number[k]), float(total[k] / max(number[k], 1)))
        for k, view in enumerate(run.model.views)
    }


def photo_table(run: KeptRun, names: Sequence[str]) -> dict[str, Any]:
    """A row per photo, the lost ones first, then those with the largest errors."""
    report = run.report
    lost = {row["image"]: row for row in report["lost"]}
    evaluation = (report.get("evaluation") or {}).get("images", {})
    seen = _observations(run)
    used: dict[str, int] = dict.fromkeys(names, 0)
    for row in report["pairs"]["each"]:
        if state(row) == USED:
            for name in row["pair"]:
                used[name] += 1

    def worst_first(name: str) -> tuple[bool, float, float]:
        error = evaluation.get(name, {}).get("position", 0.0)
        return name not in lost, -error, -seen.get(name, (0, 0.0))[1]

    rows = []
    ordered = sorted(names, key=worst_first)
    for name in ordered[:MAX_PHOTOS]:
        image = run.photos.read(name)
        observed = seen.get(name)
        rows.append(
            {
                "name": name,
                "thumbnail": image and embed(image, id="", side=THUMBNAIL),
                "observations": observed and observed[0],
                "error": observed and observed[1],
                "pairs": used[name],
                "evaluation": evaluation.get(name),
                "lost": lost.get(name),
                "advice": advice(lost[name]) if name in lost else None,
            }
        )
    if len(rows) == len(names):  # all fit: an order that readers find their way in
        rows.sort(key=lambda row: (row["lost"] is None, row["name"]))
    return {
        "rows": rows,
        "left_out": sum(name not in lost for name in ordered[MAX_PHOTOS:]),
        "more_lost": [lost[name] for name in ordered[MAX_PHOTOS:] if name in lost],
        "evaluated": bool(evaluation),
        "skipped": report["images"]["skipped"],
    }


def stage_table(seconds: Mapping[str, float]) -> list[tuple[str, str, float]]:
    """Stage, its time, and its share of the longest."""
    longest = max(seconds.values(), default=0.0) or 1.0
    return [(stage, duration(s), s / longest) for stage, s in seconds.items()]


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value is None else str(value)


def flat(options: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested options as rows of name and value."""
    rows = []
    for name, value in options.items():
        if isinstance(value, Mapping):
            rows += flat(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, _shown(value)))
    return rows


def next_steps(folder: Path, images: Path | None, *, model: bool) -> list[tuple[str, str]]:
    """What to do with the result: a sentence and a command."""
    out = folder.absolute()
    quoted = shlex.quote(str(out))
    photos = shlex.quote(str(images.absolute())) if images else "PHOTOS"
    steps = []
    if model:
        steps = [
            ("Look at the model with photos in the browser", f"jaxsfm view {quoted}"),
            ("Compare it with known poses", f"jaxsfm evaluate {quoted} --reference POSES"),
            (
                "Go on in COLMAP (dense reconstruction, viewer)",
                f"colmap gui --import_path {shlex.quote(str(out / 'sparse' / '0'))} "
                f"--database_path {shlex.quote(str(out / 'database.db'))} --image_path {photos}",
            ),
            (
                "Read it in Python",
                f"pycolmap.Reconstruction({str(out / 'sparse' / '0')!r})",
            ),
        ]
    else:
        steps = [
            ("Try again, photos enlarged", f"jaxsfm reconstruct {photos} --out NEW --preset robust")
        ]
    return [
        *steps,
        ("Make this page again", f"jaxsfm report {quoted} --images {photos}"),
    ]
