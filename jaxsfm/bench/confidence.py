"""`bench confidence`: is the confidence of a pair the share of such pairs that are right?

Pairs of photos with known poses are drawn, from one set or from two, and the second photo of each
is altered. A pair is right if at least half of its matches lie near their true epipolar lines. So
photos of different places are never right. Photos of two sets of one place are not drawn together,
because their common poses are not known.
"""

import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypedDict

from jaxsfm.bench.alterations import alter
from jaxsfm.bench.drawn_pairs import DrawnPair, drawn_pairs, posed_photos
from jaxsfm.bench.figures import BenchFigures, Cells, collect, table
from jaxsfm.bench.inputs import usable_image
from jaxsfm.bench.matches import Matcher, Matches
from jaxsfm.bench.pair_options import ConfidenceOptions
from jaxsfm.bench.reliability import (
    Bin,
    bins,
    calibration_error,
    curve_at,
    fitted_curve,
    squared_error,
    write_diagram,
)
from jaxsfm.bench.strecha_sets import read_sets
from jaxsfm.bench.wxbs import HALVES, half_of
from jaxsfm.config import PRESETS
from jaxsfm.io.images import read_image
from jaxsfm.sfm.two_photos.matched import confidence

RIGHT_SHARE = 0.5
"""A pair is right if so large a share of its matches is near its epipolar lines."""


class ConfidenceRow(TypedDict):
    """The figures of one pair, one method and one seed."""

    pair: str
    half: str
    method: str
    one_place: bool
    """Whether both photos are of one set."""
    matches: int
    near: float
    """The share of the matches that are near their epipolar lines."""
    right: bool
    evidence: float
    confidence: float
    seconds: float


class Reliability(TypedDict):
    """How far the confidences of a method can be relied on."""

    pairs: int
    bins: list[Bin]
    calibration_error: float
    squared_error: float
    fitted: tuple[float, float] | None
    """The evidence with a confidence of one half, and the power, that fit half A best."""
    on_other_half: tuple[float, float] | None
    """The squared error on half B of the curve that `match` uses, and of the fitted one."""


Reliabilities = dict[str, Reliability]
"""By method."""


def bench_confidence(options: ConfidenceOptions) -> BenchFigures[ConfidenceRow, Reliabilities]:
    """Match drawn pairs.

    Raises:
      UserError: a set or an option cannot be used.
    """
    methods = options.chosen_methods(list(PRESETS))
    sets = [posed_photos(each) for each in read_sets(options.root, options.chosen_sets())]
    pairs = drawn_pairs(sets, options.pairs)
    figures = collect("confidence", _rows(pairs, methods, options), summary, cells, options)
    if options.diagram is not None:
        found = {method: of["bins"] for method, of in figures["summary"].items()}
        write_diagram(options.diagram, found)
    return figures


def _rows(
    pairs: Iterator[DrawnPair], methods: Sequence[str], options: ConfidenceOptions
) -> Iterator[ConfidenceRow]:
    matcher = Matcher(options)
    for pair in pairs:
        original = usable_image(pair.second.path)
        rgb = read_image(original, max_size=max(original.size)).rgb
        altered = alter(rgb, pair.alteration, seed=zlib.crc32(pair.name.encode()))
        with TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            second = altered.written(Path(scratch) / "second.png")
            photos = usable_image(pair.first.path, name="first"), second
            for method in methods:
                for run in matcher.match(*photos, method):
                    yield _row(pair, method, run, pair.near_share(altered, run))


def _row(pair: DrawnPair, method: str, run: Matches, near: float) -> ConfidenceRow:
    evidence = run.evidence or 0.0
    return {
        "pair": pair.name,
        "half": half_of(pair.name),
        "method": method,
        "one_place": pair.one_place,
        "matches": len(run.xy0),
        "near": near,
        "right": near >= RIGHT_SHARE,
        "evidence": evidence,
        "confidence": confidence(evidence),
        "seconds": run.seconds,
    }


def summary(rows: Sequence[ConfidenceRow]) -> Reliabilities:
    """The reliability of each method's confidences."""
    return {
        method: _reliability([row for row in rows if row["method"] == method])
        for method in dict.fromkeys(row["method"] for row in rows)
    }


def _reliability(rows: Sequence[ConfidenceRow]) -> Reliability:
    chosen, tested = ([row for row in rows if row["half"] == half] for half in HALVES)
    fitted = fitted_curve([r["evidence"] for r in chosen], [r["right"] for r in chosen])
    other = None
    if fitted is not None and tested:
        truth = [row["right"] for row in tested]
        other = (
            squared_error([row["confidence"] for row in tested], truth),
            squared_error(curve_at([row["evidence"] for row in tested], fitted), truth),
        )
    found = bins([row["confidence"] for row in rows], [row["right"] for row in rows])
    return {
        "pairs": len(rows),
        "bins": found,
        "calibration_error": calibration_error(found),
        "squared_error": squared_error(
            [row["confidence"] for row in rows], [row["right"] for row in rows]
        ),
        "fitted": fitted,
        "on_other_half": other,
    }


def cells(row: ConfidenceRow) -> Cells:
    """A row of the table."""
    return {
        "pair": row["pair"],
        "method": row["method"],
        "matches": str(row["matches"]),
        "near": f"{row['near']:.2f}",
        "evidence": f"{row['evidence']:.0f}",
        "confidence": f"{row['confidence']:.3f}",
        "seconds": f"{row['seconds']:.1f}",
    }


def table_lines(result: BenchFigures[ConfidenceRow, Reliabilities]) -> list[str]:
    """The reliability diagram of each method as a table, and what fits half A."""
    lines = table(
        [
            {
                "method": method,
                "confidence above": f"{each['above']:g}",
                "pairs": str(each["count"]),
                "mean confidence": f"{each['confidence']:.3f}",
                "right": f"{each['right']:.3f}",
            }
            for method, found in result["summary"].items()
            for each in found["bins"]
        ],
        names=1,
    )
    for method, found in result["summary"].items():
        line = (
            f"{method}: calibration error {found['calibration_error']:.3f}, squared error "
            f"{found['squared_error']:.3f}"
        )
        if found["fitted"] is not None and found["on_other_half"] is not None:
            half, power = found["fitted"]
            ours, theirs = found["on_other_half"]
            line += (
                f"; half A is fitted best by a curve at {half:.0f} with power {power:.1f}, which "
                f"has {theirs:.3f} on half B, and the curve in use {ours:.3f}"
            )
        lines.append(line)
    return lines
