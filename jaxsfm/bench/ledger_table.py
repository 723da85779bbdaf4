"""The rows of `bench ledger`, what they add up to, and their tables as text and as Markdown.

One table has the error rates of the check over its threshold: false alarms, and wrong models that
pass.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple, TypedDict

import numpy as np
from scipy.stats import binomtest

from jaxsfm.bench.figures import BenchFigures, Cells, table
from jaxsfm.bench.judges import Outcome
from jaxsfm.bench.ledger_sets import Half, Kind

SURE = 0.95
"""The probability of the intervals (Clopper and Pearson)."""
THRESHOLDS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)


class RootsiftFigures(TypedDict):
    """What COLMAP makes of the photos of a set with its own features."""

    registered: int
    """Photos in any model."""
    position: float | None
    rotation_deg: float | None
    seconds: dict[str, float]
    """By stage. Extraction is part of its matching."""


class LedgerRow(TypedDict):
    """The figures of one set and one seed."""

    set: str
    kind: Kind
    half: Half
    seed: int
    without: str
    """The step that was left out; empty: none."""
    images: int
    registered: int
    """Photos in any model."""
    largest: int
    """Photos in the first model."""
    models: list[int]
    """The number of photos of each model."""
    right: int | None
    """Photos in the largest groups of right models; None: not judged."""
    position: float | None
    """The mean error of the first model's cameras, units of the reference."""
    rotation_deg: float | None
    verdict: str
    """The worst over the models; empty if none was checked."""
    outcome: Outcome | Literal["ended in an error"]
    doubt: str
    """What the run says against its models; empty if it says nothing."""
    wrong: float | None
    """How probably a model is wrong, as the check says; the largest of all models. None: no model
    was checked."""
    error: str
    """Why the run ended; empty if it has a report."""
    mappings: int | None
    """How often all photos were mapped; None: the report does not say."""
    seconds: dict[str, float]
    """By stage."""
    total_seconds: float
    rootsift: RootsiftFigures | None
    """Of one run for all seeds; None for rendered scenes."""
    times_rootsift: float | None
    """How many times as long as RootSIFT's run."""


class LedgerCounts(TypedDict):
    """What the rows of a kind and a half add up to. A set has a row for each seed."""

    kind: Kind
    half: Half
    rows: int
    judged: int
    """Those that have a reference."""
    good: int
    """Right, whole and green."""
    split: int
    doubted: int
    """False alarms: every model is right (whole or split), and the run doubts one."""
    of_right: int
    """The rows with right models, to which `doubted` belongs."""
    doubted_share: tuple[float, float] | None
    """The interval of the share of false alarms, as if all rows were independent."""
    missed: int
    """Wrong, and the run does not doubt it."""
    noticed: int
    """Wrong, and the run doubts it."""
    no_model: int
    errors: int
    right_share: float | None
    """The mean share of right photos, over judged rows."""
    times_rootsift: float | None
    """The mean."""


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


LedgerFigures = BenchFigures[LedgerRow, list[LedgerCounts]]


def counts(rows: list[LedgerRow]) -> list[LedgerCounts]:
    """What the rows add up to, for each kind and half."""
    parts: dict[tuple[Kind, Half], list[LedgerRow]] = {}
    for row in rows:
        parts.setdefault((row["kind"], row["half"]), []).append(row)
    return [_counts(kind, half, part) for (kind, half), part in parts.items()]


def _counts(kind: Kind, half: Half, rows: list[LedgerRow]) -> LedgerCounts:
    right = [row for row in rows if row["outcome"] in ("right", "split")]
    doubted, outcomes = sum(bool(row["doubt"]) for row in right), [row["outcome"] for row in rows]
    shares = [row["right"] / row["images"] for row in rows if row["right"] is not None]
    times = [t for row in rows if (t := row["times_rootsift"]) is not None]
    interval = None
    if right:
        found = binomtest(doubted, len(right)).proportion_ci(SURE)
        interval = float(found.low), float(found.high)
    return {
        "kind": kind,
        "half": half,
        "rows": len(rows),
        "judged": len(shares),
        "good": sum(row["outcome"] == "right" and row["verdict"] == "green" for row in rows),
        "split": outcomes.count("split"),
        "doubted": doubted,
        "of_right": len(right),
        "doubted_share": interval,
        "missed": outcomes.count("wrong, not noticed"),
        "noticed": outcomes.count("wrong, noticed"),
        "no_model": outcomes.count("no model"),
        "errors": outcomes.count("ended in an error"),
        "right_share": float(np.mean(shares)) if shares else None,
        "times_rootsift": float(np.mean(times)) if times else None,
    }


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


def _range(values: Iterable[float | None], form: Callable[[float], str]) -> str:
    """The smallest and the largest value as text, or one of them if both read the same."""
    there = [value for value in values if value is not None]
    if not there:
        return ""
    return "-".join(dict.fromkeys([form(min(there)), form(max(there))]))


def set_cells(rows: Sequence[LedgerRow]) -> Cells:
    """A row of the table, of the rows of one set."""
    first = rows[0]

    def photos(numbers: Iterable[int | None]) -> str:
        found = _range(numbers, "{:.0f}".format)
        return found and f"{found}/{first['images']}"

    def words(each: Iterable[str]) -> str:
        return "; ".join(dict.fromkeys(filter(None, each)))

    return {
        "set": first["set"],
        "registered": photos(row["registered"] for row in rows),
        "right": photos(row["right"] for row in rows),
        "position": _range((row["position"] for row in rows), "{:.4f}".format),
        "rotation, deg": _range((row["rotation_deg"] for row in rows), "{:.3f}".format),
        "verdict": words(row["verdict"] for row in rows),
        "outcome": words(row["outcome"] for row in rows),
        "seconds": _range((row["total_seconds"] or None for row in rows), "{:.0f}".format),
        "times RootSIFT": _range((row["times_rootsift"] for row in rows), "{:.1f}".format),
    }


def cells(row: LedgerRow) -> Cells:
    """A row of the table, of one seed."""
    found = set_cells([row])
    stages = ", ".join(f"{name} {value:.0f}" for name, value in row["seconds"].items())
    return {"set": found.pop("set"), "seed": str(row["seed"]), **found, "stages": stages}


def counts_cells(each: LedgerCounts) -> Cells:
    """A row of the table of sums."""
    alarms = f"{each['doubted']} of {each['of_right']}"
    if each["doubted_share"] is not None:
        low, high = each["doubted_share"]
        alarms += f" ({100 * low:.0f} to {100 * high:.0f} %)"
    share, times = each["right_share"], each["times_rootsift"]
    return {
        "kind": each["kind"],
        "half": each["half"],
        "rows": str(each["rows"]),
        "judged": str(each["judged"]),
        "right, whole, green": str(each["good"]),
        "split": str(each["split"]),
        "right, doubted": alarms,
        "wrong, green": str(each["missed"]),
        "wrong, noticed": str(each["noticed"]),
        "no model": str(each["no_model"]),
        "errors": str(each["errors"]),
        "right photos": "" if share is None else f"{100 * share:.1f} %",
        "times RootSIFT": "" if times is None else f"{times:.1f}",
    }


def curve_cells(each: ErrorRates) -> Cells:
    """A row of the table of the curve."""
    return {
        "doubted above": f"{each.threshold:g}",
        "right, doubted": f"{each.false_alarms} of {each.right}",
        "wrong, passed": f"{each.misses} of {each.wrong}",
    }


def table_lines(figures: LedgerFigures) -> list[str]:
    """All rows, why runs ended or doubt their models, the sums, and the check's error rates."""
    lines = table([cells(row) for row in figures["rows"]])
    for row in figures["rows"]:
        if said := row["error"] or row["doubt"]:
            lines.append(f"{row['set']}, seed {row['seed']}: {said}")
    lines += ["", *table([counts_cells(each) for each in figures["summary"]])]
    curve = [curve_cells(each) for each in error_curve(figures["rows"])]
    return [*lines, "", *table(curve, names=1)]


def _markdown(rows: Sequence[Cells]) -> list[str]:
    """Rows as a table in Markdown."""
    heads = list(dict.fromkeys(head for row in rows for head in row))
    lines = [heads, ["---"] * len(heads), *([row.get(head, "") for head in heads] for row in rows)]
    return ["| " + " | ".join(text.replace("|", r"\|") for text in line) + " |" for line in lines]


def markdown(figures: LedgerFigures, date: str, commit: str) -> str:
    """The ledger in Markdown: a line for each set, and the sums.

    Args:
      commit: of the software; empty if it is not known.
    """
    sets: dict[str, list[LedgerRow]] = {}
    for row in figures["rows"]:
        sets.setdefault(row["set"], []).append(row)
    seeds = len({row["seed"] for row in figures["rows"]})
    caption = f"Ledger of {date}" + (f", commit {commit}" if commit else "")
    caption += f", {seeds} seed" + ("s" if seeds != 1 else "")
    left_out = dict.fromkeys(row["without"] for row in figures["rows"] if row["without"])
    caption += "".join(f", without {step}" for step in left_out)
    lines = [f"**{caption}.** Where seeds differ, the smallest and the largest figure.", ""]
    lines += _markdown([{"kind": of[0]["kind"]} | set_cells(of) for of in sets.values()])
    return "\n".join([*lines, "", *_markdown([*map(counts_cells, figures["summary"])]), ""])
