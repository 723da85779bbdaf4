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
from jaxsfm.io.pairs import Pair, PairResult
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
    """The top-left corner of the cell of FINE_STRIDE pixels; None if no such cell matched."""
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
      names: the photos, sorted.
      xy: float (n, 2), the observations in them, original pixels.
      radius: the largest distance between a keypoint and its observation, original pixels.

    Returns:
      (cell, keypoint) by the place of a photo in `names`.
    """
    found = []
    for i, j in itertools.combinations(range(len(names)), 2):
        result = load((names[i], names[j]))
        if result is None or not result.num_inliers:
            continue
        off = np.maximum(
            np.linalg.norm(result.keypoints0 - xy[i], axis=1),
            np.linalg.norm(result.keypoints1 - xy[j], axis=1),
        )
        k = int(np.argmin(off))
        if off[k] < radius:
            first, second = result.cells[k].tolist()
            found.append((float(off[k]), i, first, result.keypoints0[k]))
            found.append((float(off[k]), j, second, result.keypoints1[k]))
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
    tracks = model.tracks
    seen = [(model.views[tracks.view[k]].name, k) for k in np.flatnonzero(tracks.point == point)]
    names, rows = map(list, zip(*sorted(seen), strict=True))
    shown = [
        (k, image) for k, name in enumerate(names[:PHOTOS]) if (image := run.photos.read(name))
    ]
    if len(shown) < 2:
        return None
    radius = NEAR_PX * max(max(image.scale) for _, image in shown)
    cells = _cells(load, names[:MATCHED], tracks.xy[rows[:MATCHED]], radius)
    patches = [_patch(names[k], image, tracks.xy[rows[k]], cells.get(k)) for k, image in shown]
    if sum(patch.cell is not None for patch in patches) < 2:
        return None
    return ShownTrack(len(rows), float(np.mean(run.errors[rows])), patches)


def close_ups(run: FinishedRun) -> list[ShownTrack]:
    """A few tracks; none if the model, the photos or the matches are gone."""
    model = run.model
    if model is None:
        return []
    load = functools.cache(run.matches.load_matches)
    found = (_track(run, model, load, point) for point in _candidates(model.tracks))
    return list(itertools.islice((track for track in found if track), TRACKS))
