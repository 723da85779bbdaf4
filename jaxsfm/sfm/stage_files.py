"""The figures that the stages of a reconstruction leave beside their models, as JSON."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from jaxsfm.colmap.mapper import Attempt
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.refine.passes import PassFigures, RefinementFigures
from jaxsfm.sfm.refine.weak_views import Placement
from jaxsfm.sfm.view_graph import Verdict

FIGURES = "figures.json"


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerificationFigures:
    """The results of verification and of the view graph."""

    verdicts: dict[Pair, Verdict]
    """The view graph's decisions, by pair; empty if it is switched off."""
    verified: dict[Pair, int]
    """Number of two-view inliers, by pair that has any."""
    angles: dict[Pair, float]
    """Degrees at which the rays of a verified pair's points meet (median); 0: unknown."""


def write_verification(folder: Path, figures: VerificationFigures) -> None:
    """Write the figures of the stage `verified` into its folder."""
    plain = {
        "verdicts": [[pair, dataclasses.asdict(v)] for pair, v in figures.verdicts.items()],
        "verified": [
            [pair, count, figures.angles[pair]] for pair, count in figures.verified.items()
        ],
    }
    (folder / FIGURES).write_text(json.dumps(plain), encoding="utf-8")


def read_verification(folder: Path) -> VerificationFigures:
    """Read what `write_verification` wrote."""
    plain = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
    return VerificationFigures(
        verdicts={(a, b): Verdict(**row) for (a, b), row in plain["verdicts"]},
        verified={(a, b): count for (a, b), count, _ in plain["verified"]},
        angles={(a, b): angle for (a, b), _, angle in plain["verified"]},
    )


def write_attempts(folder: Path, attempts: Sequence[Attempt]) -> None:
    """Write the figures of the stage `mapped` into its folder."""
    plain = [dataclasses.asdict(attempt) for attempt in attempts]
    (folder / FIGURES).write_text(json.dumps(plain), encoding="utf-8")


def read_attempts(folder: Path) -> list[Attempt]:
    """Read what `write_attempts` wrote."""
    attempts = []
    for row in json.loads((folder / FIGURES).read_text(encoding="utf-8")):
        pair = row["initial_pair"]
        attempts.append(Attempt(**row | {"initial_pair": pair and tuple(pair)}))
    return attempts


def write_refinement(folder: Path, figures: Sequence[RefinementFigures | None]) -> None:
    """Write the figures of the stage `refined` into its folder; None: a model was not refined."""
    plain = [each and dataclasses.asdict(each) for each in figures]
    (folder / FIGURES).write_text(json.dumps(plain), encoding="utf-8")


def read_refinement(folder: Path) -> list[RefinementFigures | None]:
    """Read what `write_refinement` wrote."""
    return [
        row
        and RefinementFigures(
            passes=[PassFigures(**each) for each in row["passes"]],
            placed=[Placement(**each) for each in row["placed"]],
        )
        for row in json.loads((folder / FIGURES).read_text(encoding="utf-8"))
    ]
