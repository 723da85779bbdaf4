"""What a run did, as plain JSON and as the last lines on the screen."""

import dataclasses
from collections.abc import Container, Mapping, Sequence
from typing import Any

from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, PairCounts, describe
from jaxsfm.sfm.view_graph import Verdict

MAX_GROUPS = 10
"""Groups of images named in the last lines; report.json has them all."""


def model_figures(model: Any) -> dict[str, Any]:
    """The numbers of one COLMAP model."""
    return {
        "registered": model.num_reg_images(),
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "track_length": model.compute_mean_track_length(),
        "reprojection_error_px": model.compute_mean_reprojection_error(),
        "images": sorted(model.image(i).name for i in model.reg_image_ids()),
    }


def evaluation_lines(evaluation: Mapping[str, Any]) -> list[str]:
    """An evaluation as text."""
    position, rotation = evaluation["position"], evaluation["rotation_deg"]
    shares = ", ".join(f"{d}: {100 * s:.0f} %" for d, s in evaluation["within_10deg"].items())
    return [
        f"reference        {evaluation['registered']} of {evaluation['reference_images']} images, "
        f"aligned on {evaluation['aligned_on']}",
        *(
            f"{label} mean {e['mean']:.4f}  median {e['median']:.4f}  max {e['max']:.4f} {unit}"
            for label, e, unit in (
                ("position error  ", position, "(units of the reference)"),
                ("rotation error  ", rotation, "deg"),
            )
        ),
        f"within (d; 10 deg)  {shares}",
    ]


def named(names: Sequence[str], most: int = 3) -> str:
    """The first of a list of names, and how many more there are."""
    shown = ", ".join(shown_name(name) for name in names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown


def component_lines(report: Mapping[str, Any]) -> list[str]:
    """The groups of images that trusted pairs join, where they are not one, and what parts them."""
    groups = report["view_graph"]["components"]
    several = [group for group in groups if len(group["images"]) > 1]
    if len(several) < 2:
        return []
    alone = len(groups) - len(several)
    sizes = ", ".join(str(len(group["images"])) for group in several[:MAX_GROUPS])
    lines = [
        f"view graph       {len(several)} groups of images that no trusted pair joins, of {sizes}"
        + ", ..." * (len(several) > MAX_GROUPS)
        + f" images; {alone} images alone" * bool(alone)
    ]
    for group in several[1:MAX_GROUPS]:
        near = group["nearest"]
        lines.append(
            f"group            {named(group['images'])}: "
            + (
                f"nearest to the others is {describe((near['pair'][0], near['pair'][1]))}: "
                f"{near['missed']}"
                if near
                else "no pair with any other was tried"
            )
        )
    return lines


def help_lines(lost: Sequence[Mapping[str, Any]]) -> list[str]:
    """What could help the lost images, each option once with those it could help."""
    helped: dict[str | None, dict[str, str]] = {}
    for row in lost:
        for each in row.get("help", ()):
            helped.setdefault(each["option"], {})[row["image"]] = each["reason"]
    lines = []
    for option in sorted(helped, key=lambda option: (option is None, option)):
        images, reasons = list(helped[option]), list(helped[option].values())
        first = f"for {shown_name(images[0])}, " * (len(set(reasons)) > 1) + reasons[0]
        lines.append(f"may help         {option or 'more photos'} ({named(images)}): {first}")
    return lines


def summary_lines(report: Mapping[str, Any]) -> list[str]:
    """The run's last words; without a model, the reason first."""
    images, pairs = report["images"], report["pairs"]
    lines = [f"no model         {report['no_model']}"] * bool(report["no_model"])
    lines += [
        f"images           {images['usable']} usable of {images['found']}",
        f"pairs            {pairs['tried']} tried, {pairs['verified']} verified, "
        f"{pairs['handed_on']} handed to COLMAP"
        + (f", {pairs['trusted']} trusted" if pairs["trusted"] is not None else ""),
    ]
    if given := report.get("given"):
        lines.append(
            f"given            {given['matches']} matches in {given['pairs']} pairs of "
            f"{given['images']} images, mapped beside"
        )
    models = report["models"]
    if models:
        best = models[0]
        lines += [
            f"registered       {best['registered']} of {images['usable']} images"
            + (
                f" (and {len(models) - 1} smaller model{'s' * (len(models) > 2)})"
                if len(models) > 1 and best["registered"] < images["usable"]
                else ""
            ),
            f"points           {best['points']}, mean track length {best['track_length']:.2f}, "
            f"reprojection error {best['reprojection_error_px']:.2f} px",
        ]
    else:
        lines.append(f"registered       none of {images['usable']} images")
    attempts = report["mapping"]
    if len(attempts) > 1:
        tries = ", ".join(str(max(a["registered"], default=0)) for a in attempts)
        lines.append(f"mapping          started {len(attempts)} times, images registered: {tries}")
    refinement = report["refinement"][0] if report["refinement"] else None
    if refinement and refinement["passes"]:
        last = refinement["passes"][-1]
        lines.append(
            f"refinement       {last['kept']} observations agreed, {last['dropped']} dropped, "
            f"{last['added']} added in the last of {len(refinement['passes'])} passes"
            + ("" if last["accepted"] else "; too few, taken back")
        )
        for at in refinement["placed"]:
            if not at["octave_px"] and (not at["registered"] or at.get("held") is not None):
                continue  # it is among the lost
            name, px = shown_name(at["name"]), at["octave_px"]
            lines.append(
                f"placed           {name}: {at['agreed']} points agree at "
                f"{'full' if px == 1 else f'1/{px}'} size, {at['error_px']:.1f} px"
                + ("" if at["registered"] else "; the mapper had left it out")
                if px
                else f"not refined      {name}: too few points agree; the old observations stay"
            )
    seconds = report["seconds"]
    lines.append("seconds          " + ", ".join(f"{k} {v:.1f}" for k, v in seconds.items()))
    if pairs["overflowed"]:
        lines.append(f"warning          {pairs['overflowed']} pairs had more matches than kept")
    lines += component_lines(report)
    lines += [f"skipped          {reason}" for reason in images["skipped"].values()]
    lines += [
        f"lost             {shown_name(row['image'])}: {row['stage']} ({row['detail']})"
        for row in report["lost"]
    ]
    lines += help_lines(report["lost"])
    if report.get("evaluation"):
        lines += evaluation_lines(report["evaluation"])
    if report.get("evaluation_failed"):
        lines.append(f"not evaluated    {report['evaluation_failed']}")
    return lines


def pair_figures(
    pair: Pair,
    counts: PairCounts,
    chosen: Container[Pair],
    verified: dict[Pair, int],
    verdicts: dict[Pair, Verdict],
) -> dict[str, Any]:
    """A pair's part of the report, plain JSON."""
    verdict = verdicts.get(pair)
    return {
        "pair": list(pair),
        "status": counts.status.name.lower(),
        "tentative": counts.num_tentative,
        "inliers": counts.num_inliers,
        "planes": counts.num_planes,
        "handed_on": pair in chosen,
        "colmap_inliers": verified.get(pair, 0),
        "view_graph": None if verdict is None else dataclasses.asdict(verdict),
    }
