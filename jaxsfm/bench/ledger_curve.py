"""The error rates of the check over its threshold: false alarms, and wrong models that pass."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxsfm.bench.figures import Cells, table
from jaxsfm.bench.ledger_table import LedgerFigures, LedgerRow, table_lines

THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)


class ErrorRates(NamedTuple):
    """How often the check is wrong about models, if it doubts those above a threshold."""

    threshold: float
    """A model is doubted if it is wrong with a larger probability, as the check says."""
    false_alarms: int
    right: int
    """The number of rows with right models."""
    misses: int
    wrong: int
    """The number of rows with a wrong model."""


def error_curve(rows: Sequence[LedgerRow]) -> list[ErrorRates]:
    """The error rates over the threshold. Only what photos contradict counts here."""
    known = [(row["outcome"], wrong) for row in rows if (wrong := row["wrong"]) is not None]
    right = [wrong for outcome, wrong in known if outcome in ("right", "split")]
    false = [wrong for outcome, wrong in known if outcome.startswith("wrong")]
    return [
        ErrorRates(
            limit,
            sum(each > limit for each in right),
            len(right),
            sum(each <= limit for each in false),
            len(false),
        )
        for limit in THRESHOLDS
    ]


def curve_cells(each: ErrorRates) -> Cells:
    """A row of the table of the curve."""
    return {
        "doubted above": f"{each.threshold:g}",
        "right, doubted": f"{each.false_alarms} of {each.right}",
        "wrong, passed": f"{each.misses} of {each.wrong}",
    }


def lines_with_curve(figures: LedgerFigures) -> list[str]:
    """All rows, the sums, and the error rates of the check over its threshold."""
    curve = [curve_cells(each) for each in error_curve(figures["rows"])]
    return [*table_lines(figures), "", *table(curve, names=1)]
