"""Checks of models as JSON."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Alternative, Contradiction, ModelCheck, OtherPlace


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
    plain = [each and _plain(each) for each in outcomes]
    file.write_text(json.dumps(plain), encoding="utf-8")


def read_outcomes(file: Path) -> list[Checked | None]:
    """Read what `write_outcomes` wrote."""
    return [row and _outcome(row) for row in json.loads(file.read_text(encoding="utf-8"))]


def _plain(found: Checked) -> dict[str, Any]:
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
