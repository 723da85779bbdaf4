"""The pairs in the page: how far they came, and pictures of the matches of some of them."""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxsfm.io.pairs import PairResult
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.page.photos import Embedded, embed
from jaxsfm.report.plane_colours import COLOURS, MAX_LINES
from jaxsfm.report.run_results import PairRow

MAX_PAIRS = 15
"""The most rows of the table of refused pairs."""
OF_A_KIND = 3
"""The number of pairs of each kind: best, weakest, refused."""
SIDE = 640
"""Longer side of a photo in the page, pixels."""
GAP = 6
"""The space between the two photos, pixels of the page."""
MAX_DOTS = 400
"""The most dots of a plane in a photo."""
NO_PLANE, NOT_CHOSEN, NOT_VERIFIED = "no plane", "not chosen", "not verified"
NOT_TRUSTED, USED = "not trusted", "used"
STATES = {
    USED: "COLMAP verified it, and it was given to the mapper",
    NOT_TRUSTED: "COLMAP verified it, but stronger pairs or the check of the model contradict it",
    NOT_VERIFIED: "it has matches, but COLMAP found no common geometry",
    NOT_CHOSEN: "it has matches, but --best-pairs left it out",
    NO_PLANE: "too few matches, or too few on a common plane",
}
"""The stages at which a pair can end, and what each means."""


def state(row: PairRow) -> str:
    """The stage at which a pair ended: a key of STATES."""
    if not row.inliers:
        return NO_PLANE
    if not row.handed_on:
        return NOT_CHOSEN
    if not row.colmap_inliers:
        return NOT_VERIFIED
    return USED if row.trusted else NOT_TRUSTED


def _refused_pairs(rows: Iterable[PairRow]) -> list[PairRow]:
    """The pairs with matches that the model does not rest on, those with most matches first."""
    refused = [row for row in rows if state(row) in (NOT_TRUSTED, NOT_VERIFIED)]
    return sorted(refused, key=lambda row: (-row.colmap_inliers, -row.inliers, row.pair))


class PairTable(NamedTuple):
    """How far all pairs came."""

    counts: list[tuple[int, str, str]]
    """The number of pairs that ended at a stage, for every stage that occurs; its name and what it
    means."""
    refused: list[tuple[PairRow, str]]
    """The refused pairs with the most matches, and why each was refused."""
    left_out: int
    """The number of refused pairs that have no row."""


def pair_table(rows: list[PairRow]) -> PairTable:
    """How far all pairs came, and the reasons why pairs with many matches were refused."""
    refused, numbers = _refused_pairs(rows), Counter(map(state, rows))
    shown = []
    for row in refused[:MAX_PAIRS]:
        reason = row.view_graph.reason if row.view_graph else ""
        shown.append((row, f"{state(row)}: {reason or STATES[state(row)]}"))
    return PairTable(
        counts=[(numbers[name], name, STATES[name]) for name in STATES if numbers[name]],
        refused=shown,
        left_out=len(refused[MAX_PAIRS:]),
    )


class Plane(NamedTuple):
    """The matches of one homography, as paths of SVG."""

    colour: str
    lines: str
    dots: str


class PairPicture(NamedTuple):
    """Two photos side by side with their matches."""

    heading: str
    row: PairRow
    photos: tuple[Embedded, Embedded]
    shift: int
    """The left edge of the second photo."""
    planes: list[Plane]
    matches: int


def _chosen(rows: list[PairRow]) -> list[tuple[str, PairRow]]:
    """The pairs that are shown, each with a heading, the best first."""
    used = [row for row in rows if state(row) == USED]
    used.sort(key=lambda row: (-row.colmap_inliers, row.pair))
    best, weakest = used[:OF_A_KIND], used[OF_A_KIND:][-OF_A_KIND:]
    return [
        *(("Among the best pairs", row) for row in best),
        *(("Among the weakest pairs that were used", row) for row in weakest),
        *(("Refused", row) for row in _refused_pairs(rows)[:OF_A_KIND]),
    ]


def _some(index: np.ndarray, limit: int) -> np.ndarray:
    return index[:: max(1, -(-len(index) // limit))]


def _planes(result: PairResult, xy0: np.ndarray, xy1: np.ndarray) -> list[Plane]:
    planes = []
    for k in range(len(result.homographies)):
        member = np.flatnonzero(result.plane == k)
        lines = [
            f"M{xy0[m, 0]:.0f} {xy0[m, 1]:.0f}L{xy1[m, 0]:.0f} {xy1[m, 1]:.0f}"
            for m in _some(member, MAX_LINES)
        ]
        some = _some(member, MAX_DOTS)
        dots = [f"M{x:.0f} {y:.0f}h0" for xy in (xy0, xy1) for x, y in xy[some]]
        planes.append(Plane(COLOURS[k % len(COLOURS)], "".join(lines), "".join(dots)))
    return planes


def _picture(
    run: FinishedRun, heading: str, row: PairRow, seen: dict[str, Embedded]
) -> PairPicture | None:
    result = run.matches.load_matches(row.pair)
    if result is None:
        return None
    for name in row.pair:
        if name not in seen and (image := run.photos.read(name)) is not None:
            seen[name] = embed(image, id=f"photo{len(seen)}", side=SIDE)
    if not seen.keys() >= set(row.pair):
        return None
    photo0, photo1 = (seen[name] for name in row.pair)
    shift = photo0.width + GAP
    xy0 = photo0.place(result.keypoints0)
    xy1 = photo1.place(result.keypoints1) + np.asarray([shift, 0])
    planes = _planes(result, xy0, xy1)
    return PairPicture(heading, row, (photo0, photo1), shift, planes, result.num_inliers)


def pair_pictures(run: FinishedRun) -> tuple[list[PairPicture], Iterable[Embedded]]:
    """Pictures of a few pairs, and the photos in them, each once.

    A pair has no picture if its photos or its matches are gone.
    """
    seen: dict[str, Embedded] = {}
    made = [_picture(run, heading, row, seen) for heading, row in _chosen(run.report.pairs.each)]
    return [picture for picture in made if picture is not None], list(seen.values())
