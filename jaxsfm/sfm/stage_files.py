"""What the stages of a reconstruction leave beside their models, as JSON: figures and checks."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsfm.colmap.mapper import Attempt
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Alternative, Contradiction, ModelCheck, OtherPlace
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.passes import RefinementFigures, figures_from_json
from jaxsfm.sfm.view_graph import Verdict

FIGURES = "figures.json"
FORMAT = 22
"""The version of what the stages leave. It is part of their keys, so that stages of another version
are not used."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerificationFigures:
    """The results of verification."""

    verified: dict[Pair, int]
    """Number of two-view inliers, by pair that has any."""
    angles: dict[Pair, float]
    """Degrees at which the rays of a verified pair's points meet (median); 0: unknown."""


def write_verification(folder: Path, figures: VerificationFigures) -> None:
    """Write the figures of the stage `verified` into its folder."""
    plain = [[pair, count, figures.angles[pair]] for pair, count in figures.verified.items()]
    (folder / FIGURES).write_text(json.dumps(plain), encoding="utf-8")


def read_verification(folder: Path) -> VerificationFigures:
    """Read what `write_verification` wrote."""
    plain = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
    return VerificationFigures(
        verified={(a, b): count for (a, b), count, _ in plain},
        angles={(a, b): angle for (a, b), _, angle in plain},
    )


def check_from_json(row: dict[str, Any]) -> ModelCheck:
    """The check whose fields are given as plain data (`dataclasses.asdict`)."""
    return ModelCheck(
        groups=row["groups"],
        contradictions=[Contradiction(**each) for each in row["contradictions"]],
        other_places=[OtherPlace(**each) for each in row["other_places"]],
        alternative=row["alternative"] and Alternative(**row["alternative"]),
        apart=row["apart"],
        told_apart=row["told_apart"],
        shrunk=row["shrunk"],
        doubt=row["doubt"],
        unconfirmed=row["unconfirmed"],
    )


def write_outcomes(file: Path, outcomes: Sequence[Checked | None]) -> None:
    """Write the outcomes of the checks of some models; None where one was not checked."""
    plain = [each and _plain_outcome(each) for each in outcomes]
    file.write_text(json.dumps(plain), encoding="utf-8")


def read_outcomes(file: Path) -> list[Checked | None]:
    """Read what `write_outcomes` wrote."""
    return [row and _outcome(row) for row in json.loads(file.read_text(encoding="utf-8"))]


def _plain_outcome(found: Checked) -> dict[str, Any]:
    return {
        "check": dataclasses.asdict(found.check),
        "refuted": _plain_pairs(found.refuted),
        "suspected": _plain_pairs(found.suspected),
        "explained": sorted(found.explained),
        "against": sorted(found.against),
        "parts": found.parts,
    }


def _outcome(row: dict[str, Any]) -> Checked:
    return Checked(
        check=check_from_json(row["check"]),
        refuted=_pairs(row["refuted"]),
        suspected=_pairs(row["suspected"]),
        explained={(a, b) for a, b in row["explained"]},
        against={(a, b) for a, b in row["against"]},
        parts=row["parts"],
    )


def _plain_pairs(found: Mapping[Pair, Contradiction]) -> list[tuple[Pair, dict[str, Any]]]:
    return [(pair, dataclasses.asdict(each)) for pair, each in found.items()]


def _pairs(rows: Sequence[tuple[Pair, dict[str, Any]]]) -> dict[Pair, Contradiction]:
    return {(a, b): Contradiction(**each) for (a, b), each in rows}


def write_mapping(folder: Path, figures: MappingFigures) -> None:
    """Write the figures of the mappings into the folder of the stage `settled`."""
    plain = {
        "verdicts": [[pair, dataclasses.asdict(v)] for pair, v in figures.verdicts.items()],
        "attempts": [dataclasses.asdict(attempt) for attempt in figures.attempts],
        "basis": figures.basis,
        "checks": [check and dataclasses.asdict(check) for check in figures.checks],
    }
    (folder / FIGURES).write_text(json.dumps(plain), encoding="utf-8")


def read_mapping(folder: Path) -> MappingFigures:
    """Read what `write_mapping` wrote."""
    plain = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
    attempts = []
    for row in plain["attempts"]:
        pair = row["initial_pair"]
        attempts.append(Attempt(**row | {"initial_pair": pair and tuple(pair)}))
    return MappingFigures(
        verdicts={(a, b): Verdict(**row) for (a, b), row in plain["verdicts"]},
        attempts=attempts,
        checks=[row and check_from_json(row) for row in plain["checks"]],
        basis=plain["basis"],
    )


def write_refinement(
    folder: Path, figures: Sequence[RefinementFigures | None], order: Sequence[int]
) -> None:
    """Write the figures of a refinement into the folder of its stage.

    Args:
      figures: for each model; None: it was not refined.
      order: for each model, its index among the models that the stage was given.
    """
    rows = [each and dataclasses.asdict(each) for each in figures]
    plain = {"models": rows, "order": list(order)}
    (folder / FIGURES).write_text(json.dumps(plain), encoding="utf-8")


def read_refinement(folder: Path) -> tuple[list[RefinementFigures | None], list[int]]:
    """Read what `write_refinement` wrote."""
    plain = json.loads((folder / FIGURES).read_text(encoding="utf-8"))
    return [row and figures_from_json(row) for row in plain["models"]], plain["order"]
