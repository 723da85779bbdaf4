"""Close-ups of tracks: the cell that matched, the keypoint in it, and its place in the model."""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.io.images import WorkingImage
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.pixels import Pixels
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.page.embedded import data_uri

TRACKS, PHOTOS = 5, 6
"""The number of tracks that are shown, and of photos of each."""
MATCHED = 12
"""The most photos of a track whose matches with each other are read."""
SIDE = 40
"""The side of a patch, working pixels."""
NEAR_PX = 6.0
"""The largest distance between a keypoint and the observation that the refinement made of it,
working pixels."""
LEAST = 4
"""The fewest photos in which a shown point was seen, if there are such points."""


class Patch(NamedTuple):
    """A part of one photo. Places are in pixels of the patch; its top-left corner is (0, 0)."""

    name: str
    uri: str
    cell: tuple[float, float] | None
    """The top-left corner of the cell of FINE_STRIDE pixels; None if no cell matched."""
    walked: tuple[float, float] | None
    """The keypoint: the pixel with the strongest features in the cell."""
    final: tuple[float, float]
    """The observation in the model."""


class ShownTrack(NamedTuple):
    """One 3-D point in some of the photos in which it was seen."""

    length: int
    error: float
    """Mean reprojection error, original pixels."""
    patches: list[Patch]


def _candidates(tracks: Tracks) -> list[int]:
    """Points that were seen in many photos, from all parts of the model."""
    lengths = tracks.num_observations()
    least = min(LEAST, int(lengths.max(initial=0)))
    long = np.flatnonzero((lengths >= least) & (lengths > 0))
    # Points that follow each other in the model are near each other in space.
    return long[np.linspace(0, len(long) - 1, 4 * TRACKS).astype(int)].tolist() if len(long) else []


def _cells(
    load: Callable[[Pair], PairResult | None], names: list[str], xy: np.ndarray, radius: float
) -> dict[int, tuple[int, np.ndarray]]:
    """The cells and keypoints of the matches that the observations of a track were made of.

    Args:
      xy: float (n, 2), the observations in the photos `names`, original pixels.
      radius: the largest distance between a keypoint and its observation, original pixels.

    Returns:
      (cell, keypoint) by the place of a photo in `names`.
    """
    found = []
    for i, j in itertools.combinations(range(len(names)), 2):
        pair = make_pair(names[i], names[j])
        result = load(pair)
        if result is None or not result.num_inliers:
            continue
        first, second = (i, j) if pair[0] == names[i] else (j, i)
        off = np.maximum(
            np.linalg.norm(result.keypoints0 - xy[first], axis=1),
            np.linalg.norm(result.keypoints1 - xy[second], axis=1),
        )
        k = int(np.argmin(off))
        if off[k] < radius:
            ends = zip((first, second), (result.keypoints0[k], result.keypoints1[k]), strict=True)
            found += [
                (float(off[k]), v, int(result.cells[k, s]), p) for s, (v, p) in enumerate(ends)
            ]
    cells: dict[int, tuple[int, np.ndarray]] = {}
    for _, view, cell, place in sorted(found, key=lambda f: f[:2]):
        cells.setdefault(view, (cell, place))
    return cells


def _patch(
    name: str, image: WorkingImage, final: np.ndarray, own: tuple[int, np.ndarray] | None
) -> Patch:
    """A patch around the cell, or around the observation if no cell matched.

    Args:
      final: float (2,), the observation in the model, original pixels.
      own: the index of the cell, and its keypoint in original pixels.
    """
    height, width = image.rgb.shape[:2]
    pixels = Pixels(image.scale)
    aligned = pixels.from_original(final)
    corner, walked = None, None
    if own is not None:
        row, column = divmod(own[0], width // FINE_STRIDE)
        corner = np.asarray([column, row]) * float(FINE_STRIDE)
        walked = pixels.from_original(own[1].astype(np.float64))
    middle = aligned if corner is None else corner + (FINE_STRIDE - 1) / 2
    x, y = np.round(middle - (SIDE - 1) / 2).astype(int)
    rows = np.clip(np.arange(y, y + SIDE), 0, height - 1)
    columns = np.clip(np.arange(x, x + SIDE), 0, width - 1)
    origin = np.asarray([x, y])

    def at(place: np.ndarray, half: float) -> tuple[float, float]:
        return tuple((place - origin + half).round(2).tolist())

    return Patch(
        name=name,
        uri=data_uri(np.ascontiguousarray(image.rgb[np.ix_(rows, columns)]), ".png"),
        cell=None if corner is None else at(corner, 0.0),
        walked=None if walked is None else at(walked, 0.5),
        final=at(aligned, 0.5),
    )


def _track(
    run: FinishedRun, model: Model, load: Callable[[Pair], PairResult | None], point: int
) -> ShownTrack | None:
    rows = np.flatnonzero(model.tracks.point == point)
    names = [model.views[model.tracks.view[row]].name for row in rows]
    shown = [
        (k, image) for k, name in enumerate(names[:PHOTOS]) if (image := run.photos.read(name))
    ]
    if len(shown) < 2:
        return None
    names, some = names[:MATCHED], rows[:MATCHED]
    scale = max(max(image.scale) for _, image in shown)
    cells = _cells(load, names, model.tracks.xy[some], NEAR_PX * scale)
    patches = [
        _patch(names[k], image, model.tracks.xy[rows[k]], cells.get(k)) for k, image in shown
    ]
    if sum(patch.cell is not None for patch in patches) < 2:
        return None
    return ShownTrack(len(rows), float(np.mean(run.errors[rows])), patches)


def close_ups(run: FinishedRun) -> list[ShownTrack]:
    """A few tracks; none if the model, the photos or the matches are gone."""
    if run.model is None:
        return []
    load = functools.lru_cache(maxsize=None)(run.matches.load_matches)
    shown: list[ShownTrack] = []
    for point in _candidates(run.model.tracks):
        track = _track(run, run.model, load, point)
        if track is not None:
            shown.append(track)
        if len(shown) == TRACKS:
            break
    return shown
