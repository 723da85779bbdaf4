"""The report of a run that was extended: the old one with what is new."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxsfm.colmap.poses import model_poses
from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairCounts
from jaxsfm.io.store import SavedMatches
from jaxsfm.report.advice import Circumstances
from jaxsfm.report.finished_run import KeptRun
from jaxsfm.report.lost_photos import explained
from jaxsfm.report.pair_outcomes import PairOutcomes
from jaxsfm.report.summary import model_figures, pair_figures
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.register.grow import ExtendedModel
from jaxsfm.sfm.view_graph import Verdict

if TYPE_CHECKING:
    import pycolmap


class New(NamedTuple):
    """What has been added to the folder."""

    images: dict[str, ImageFile]
    skipped: dict[str, str]
    """Photos that cannot be used, and why."""


def extended_report(
    kept: KeptRun,
    models: "list[pycolmap.Reconstruction]",
    grown: ExtendedModel,
    new: New,
    matches: SavedMatches,
    verified: Mapping[Pair, int],
    sizes: Mapping[str, tuple[int, int]],
) -> dict[str, Any]:
    """The run's report with what is new.

    Args:
      sizes: of every usable image that is there, old and new.
    """
    now = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    report = dict(kept.report)
    counts = {pair: result.counts for pair, result in matches.items()}
    figures = [model_figures(model) for model in models]
    images, pairs = report["images"], report["pairs"]
    skipped = {n: why for n, why in images["skipped"].items() if n not in new.images} | new.skipped
    found = images["skipped"].keys() | new.images.keys() | new.skipped.keys()
    good = {pair for pair, each in counts.items() if each.num_inliers}
    rows = [pair_figures(p, c, good, dict(verified), {}) for p, c in counts.items()]
    each = sorted([*pairs["each"], *rows], key=lambda row: row["pair"])
    report |= {
        "finished": now,
        "images": images
        | {
            "folder": kept.photos.folder and str(kept.photos.folder.absolute()),
            "found": images["found"] + len(found) - len(images["skipped"]),
            "usable": images["usable"] + len(new.images),
            "skipped": skipped,
        },
        "pairs": pairs
        | {
            "tried": pairs["tried"] + len(counts),
            "verified": pairs["verified"] + len(good),
            "handed_on": pairs["handed_on"] + len(good),
            "overflowed": pairs["overflowed"] + sum(c.num_dropped > 0 for c in counts.values()),
            # Nobody judges the new ones.
            "trusted": None if pairs["trusted"] is None else pairs["trusted"] + len(verified),
            "each": each,
        },
        "models": figures,
        **explained(
            [each["images"] for each in figures],
            _outcomes(each, kept.config.min_inliers),
            Circumstances(
                config=kept.config,
                pairs=report["options"]["pairs"],
                known_camera=report["options"]["intrinsics"] is not None,
                sizes=sizes,
            ),
            report["refinement"],
        ),
        "extended": [
            *report.get("extended", []),
            {
                "finished": now,
                "added": sorted(new.images),
                "placed": sorted(grown.placed),
                "skipped": sorted(new.skipped),
                "rounds": grown.rounds,
                "pairs": len(counts),
            },
        ],
    }
    for row in report["lost"]:
        if row["image"] in grown.located:
            row["detail"] = grown.located[row["image"]].why or row["detail"]
    for stale in ("evaluation", "evaluation_failed"):  # of the model as it was
        report.pop(stale, None)
    if kept.reference is not None:
        try:
            errors = evaluate(model_poses(models[0]), kept.reference.poses)
            report["evaluation"] = errors.as_dict()
        except UserError as error:
            report["evaluation_failed"] = str(error)
    elif kept.report["options"].get("reference") is not None:
        report["evaluation_failed"] = "the run's reference poses cannot be used any more"
    return report


def _outcomes(rows: list[dict[str, Any]], min_inliers: int) -> PairOutcomes:
    """What a report says of its pairs."""
    named = {(row["pair"][0], row["pair"][1]): row for row in rows}
    verdicts = {pair: row["view_graph"] for pair, row in named.items()}
    return PairOutcomes(
        results={
            pair: PairCounts(
                num_inliers=row["inliers"],
                num_planes=row["planes"],
                num_tentative=row["tentative"],
                num_dropped=0,
                status=Status[row["status"].upper()],
            )
            for pair, row in named.items()
        },
        handed_on={pair for pair, row in named.items() if row["handed_on"]},
        verified={pair: n for pair, row in named.items() if (n := row["colmap_inliers"])},
        verdicts={pair: Verdict(**verdict) for pair, verdict in verdicts.items() if verdict},
        angles={},
        min_inliers=min_inliers,
    )
