"""The report of a run, put together from what its stages gave."""

import dataclasses
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jaxsfm.colmap.external_matches import ExternalMatches
from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairCounts
from jaxsfm.io.store import Identity
from jaxsfm.io.versions import versions
from jaxsfm.report.advice import Circumstances
from jaxsfm.report.lost_photos import explained
from jaxsfm.report.pair_outcomes import PairOutcomes
from jaxsfm.report.summary import model_figures, pair_figures
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.reconstruction import Reconstructed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Done:
    """What a run's stages gave."""

    folder: Path
    """Of the photos."""
    identity: Identity
    usable: list[ImageFile]
    skipped: dict[str, str]
    """Why other photos were not."""
    results: Mapping[Pair, PairCounts]
    """Of every pair tried."""
    handed_on: Collection[Pair]
    given: ExternalMatches
    made: Reconstructed
    weights: dict[str, Any]
    """What the report says of them."""
    seconds: dict[str, float]


def run_report(done: Done, *, config: Config, options: RunOptions) -> dict[str, Any]:
    """The content of report.json, without the evaluation."""
    made, results = done.made, done.results
    untrusted = [pair for pair, v in made.verdicts.items() if not v.trusted]
    figures = [model_figures(model) for model in made.models]
    counts = done.given.counts(results)
    refinement = [each and dataclasses.asdict(each) for each in made.refinement]
    return {
        "version": done.identity["version"],
        "versions": versions(),
        "finished": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "identity": done.identity,
        "weights": done.weights,
        "options": {
            "config": dataclasses.asdict(config),
            **{k: v for k, v in dataclasses.asdict(options).items() if k != "progress"},
            # Read again from anywhere, as the photos' folder is.
            "reference": options.reference and options.reference.absolute(),
        },
        "images": {
            "folder": str(done.folder.absolute()),
            "found": len(done.usable) + len(done.skipped),
            "usable": len(done.usable),
            "skipped": done.skipped,
        },
        "pairs": {
            "tried": len(results),
            "verified": sum(r.num_inliers > 0 for r in results.values()),
            "handed_on": len(done.handed_on),
            "trusted": len(made.verified) - len(untrusted) if made.verdicts else None,
            "overflowed": sum(r.num_dropped > 0 for r in results.values()),
            "each": [
                pair_figures(pair, each, done.handed_on, made.verified, made.verdicts)
                for pair, each in sorted(counts.items())
            ],
        },
        "given": done.given.about,
        "models": figures,
        "mapping": [dataclasses.asdict(attempt) for attempt in made.attempts],
        "refinement": refinement,
        **explained(
            [each["images"] for each in figures],
            PairOutcomes(
                results=counts,
                handed_on=done.handed_on,
                verified=made.verified,
                verdicts=made.verdicts,
                angles=made.angles,
                min_inliers=config.min_inliers,
            ),
            Circumstances(
                config=config,
                pairs=options.pairs,
                known_camera=options.intrinsics is not None,
                sizes={image.name: image.size for image in done.usable},
            ),
            refinement,
        ),
        "seconds": done.seconds,
    }
