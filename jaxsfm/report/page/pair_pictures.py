"""Pictures of the matches of the best, the weakest and the refused pairs."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxsfm.io.pairs import PairResult
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.page.embedded import Embedded, embed
from jaxsfm.report.page.pair_states import USED, refused_pairs, state
from jaxsfm.report.plot import COLOURS, MAX_LINES
from jaxsfm.report.run_results import PairRow

OF_A_KIND = 3
"""The number of pairs of each kind: best, weakest, refused."""
SIDE = 640
"""Longer side of a photo in the page, pixels."""
GAP = 6
"""The space between the two photos, pixels of the page."""
MAX_DOTS = 400
"""The most dots of a plane in a photo."""


class Plane(NamedTuple):
    """The matches of one homography, as paths of SVG."""

    colour: str
    matches: int
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
        *(("Refused", row) for row in refused_pairs(rows)[:OF_A_KIND]),
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
        planes.append(Plane(COLOURS[k % len(COLOURS)], len(member), "".join(lines), "".join(dots)))
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
