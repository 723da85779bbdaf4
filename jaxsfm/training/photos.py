"""The photos that are trained on: square crops of them, and pairs whose cameras are known.

A crop is what the views of a training step are made from. Epipolar supervision is training on real
pairs of photos whose cameras are known. These photos are matched once, with the preset `paper`.
Matches whose cells lie near the true epipolar line are kept. A training step cuts windows out of
both photos around one match, and uses all matches that lie inside both windows.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Collection, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.colmap.intrinsics import Intrinsics, check_fits
from jaxsfm.colmap.poses import CameraPose, Poses
from jaxsfm.config import preset
from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.core.losses import CellPairs
from jaxsfm.core.soft_matching import fundamental_matrix
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, read_image, working_size
from jaxsfm.io.photos import Pixels
from jaxsfm.io.weights import Weights
from jaxsfm.matching.pipeline import extract, match
from jaxsfm.sfm.epipolar import sampson_error
from jaxsfm.training.objective import Examples, walked_maps

NEIGHBOURS = 3
"""The number of photos that each photo is paired with: those whose cameras are nearest to it, among
those that look in a similar direction."""
MIN_COSINE = 0.7
"""The least cosine of the angle between the optical axes of a pair (45 degrees)."""
MAX_ERROR_PX = 8.0
"""The largest distance of the centres of matched cells to the epipolar geometry: a cell's side."""
MIN_MATCHES = 50
"""A pair with fewer matches is not used."""
CAPACITY = 256
"""The most matches of a window."""
MAX_SIZE = 1024
"""Longer side of the photos, pixels. At this size, a view of 192 pixels usually shows more than a
patch of wall."""
DECODED = 64
"""The number of decoded photos that are kept in memory, 2 MB each."""
HELD_OUT = 5
"""Every fifth photo is held out: it is not trained on, but used to measure the progress."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Pair:
    images: tuple[ImageFile, ImageFile]
    f: np.ndarray
    """float64 (3, 3): the fundamental matrix in working pixels, x1' F x0 = 0."""
    cells: tuple[np.ndarray, np.ndarray]
    """int (n, 2) each: (row, column) of the matched cells."""


class PosedPairs:
    """Windows of pairs of photos with known cameras; `posed_pairs` makes one.

    The windows of a step depend on the pairs, the seed and the step alone.
    """

    def __init__(self, pairs: Sequence[_Pair], *, view: int, batch: int, seed: int) -> None:
        self._pairs, self._view, self._batch, self._seed = list(pairs), view, batch, seed
        self._read = functools.lru_cache(maxsize=DECODED)(_working)

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def digest(self) -> str:
        """The SHA-256 of all that the windows are drawn from."""
        whole = hashlib.sha256()
        for pair in self._pairs:
            whole.update("".join(image.sha256 for image in pair.images).encode())
            whole.update(pair.f.tobytes())
            whole.update(pair.cells[0].tobytes())
        return whole.hexdigest()

    def draw(self, step: int, weights: Weights) -> Examples:
        """Draw the windows of a step and compute their maps."""
        rng = np.random.default_rng([self._seed, step])
        windows = [self._window(rng) for _ in range(self._batch)]
        views0, views1, cells, known = (list(part) for part in zip(*windows, strict=True))
        maps = [
            walked_maps(
                weights.params, jnp.asarray(np.stack(views)), preprocessing=weights.preprocessing
            )
            for views in (views0, views1)
        ]
        batch = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *cells)
        return Examples(maps[0], maps[1], batch, jnp.asarray(np.stack(known), jnp.float32))

    def _window(
        self, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, CellPairs, np.ndarray]:
        pair = self._pairs[int(rng.integers(len(self._pairs)))]
        chosen = int(rng.integers(len(pair.cells[0])))
        side = self._view // FINE_STRIDE
        views, inside, starts = [], np.ones(len(pair.cells[0]), bool), []
        for image, cells in zip(pair.images, pair.cells, strict=True):
            rgb = self._read(image)
            most = np.asarray(rgb.shape[:2]) // FINE_STRIDE - side
            start = np.clip(cells[chosen] - side // 2, 0, most)
            # Cells at the border are left out: the network sees zeros instead of the photo there.
            inside &= ((cells > start) & (cells < start + side - 1)).all(axis=1)
            row, col = FINE_STRIDE * start
            views.append(rgb[row : row + self._view, col : col + self._view].astype(np.float32))
            starts.append(start)
        some = np.flatnonzero(inside)
        some = rng.permutation(some)[:CAPACITY]
        both = np.zeros((2, CAPACITY, 2), np.int32)
        for k in (0, 1):
            both[k, : len(some)] = pair.cells[k][some] - starts[k]
        weight = (np.arange(CAPACITY) < len(some)).astype(np.float32)
        shift = [np.eye(3), np.eye(3)]
        for k in (0, 1):
            shift[k][:2, 2] = FINE_STRIDE * starts[k][::-1]
        f = shift[1].T @ pair.f @ shift[0]
        return (
            views[0],
            views[1],
            CellPairs(*map(jnp.asarray, (*both, weight))),
            f / np.linalg.norm(f),
        )


def posed_pairs(
    weights: Weights,
    images: Sequence[ImageFile],
    poses: Poses,
    intrinsics: Intrinsics,
    *,
    view: int,
    batch: int,
    seed: int,
) -> PosedPairs:
    """Match the photos that have a pose with their neighbours.

    Args:
      images: the photos; those without a pose are left out.
      intrinsics: one pinhole camera for all photos.

    Raises:
      UserError: no pair has enough matches, the camera has distortion, or the photos differ in
        size.
    """
    images = [
        image
        for image in images
        if image.name in poses and min(working_size(image.size, MAX_SIZE)) >= view
    ]
    check_fits(intrinsics, {image.name: image.size for image in images})
    if len(images) < 2:
        raise UserError(
            f"--reference: {len(images)} of the photos have a pose and {view} pixels a side; "
            "2 are needed"
        )
    by_name = {image.name: image for image in images}
    config = preset("paper")
    config = dataclasses.replace(config, max_size=MAX_SIZE)
    features = extract(weights, images, config=config)
    found = match(features, neighbours(by_name, poses), config=config, seed=seed)
    pairs = []
    for (a, b), result in sorted(found.items()):
        files = (by_name[a], by_name[b])
        columns = [int(features[name].dense.fine_grid[1]) for name in (a, b)]
        cells = [
            np.stack(np.divmod(result.cells[:, k].astype(np.int64), columns[k]), axis=1)
            for k in (0, 1)
        ]
        k0, k1 = (camera_matrix(intrinsics, features[name].scale) for name in (a, b))
        f = _fundamental(poses[a], poses[b], k0, k1)
        centres = [Pixels.octave(FINE_STRIDE).to_original(cell[:, ::-1]) for cell in cells]
        near = np.abs(sampson_error(f, *centres)) < MAX_ERROR_PX
        if near.sum() >= MIN_MATCHES:
            pairs.append(_Pair(images=files, f=f, cells=(cells[0][near], cells[1][near])))
    if not pairs:
        raise UserError(
            f"--reference: no two photos have {MIN_MATCHES} matches near their epipolar lines"
        )
    return PosedPairs(pairs, view=view, batch=batch, seed=seed)


def _working(image: ImageFile) -> np.ndarray:
    return read_image(image, max_size=MAX_SIZE).rgb


def neighbours(images: Collection[str], poses: Poses) -> set[tuple[str, str]]:
    chosen = set()
    for a in images:
        seen = [
            b for b in images if b != a and poses[a].rotation[2] @ poses[b].rotation[2] > MIN_COSINE
        ]
        seen.sort(key=lambda b: (float(np.linalg.norm(poses[a].centre - poses[b].centre)), b))
        chosen |= {(min(a, b), max(a, b)) for b in seen[:NEIGHBOURS]}
    return chosen


def camera_matrix(intrinsics: Intrinsics, scale: tuple[float, float]) -> np.ndarray:
    """The camera matrix of the working image; the centre of its top-left pixel is (0, 0)."""
    if intrinsics.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise UserError(f"--intrinsics: training needs a pinhole camera; got {intrinsics.model}")
    *focal, cx, cy = intrinsics.params
    x, y = Pixels(scale).from_colmap(np.asarray([cx, cy]))
    return np.asarray([[focal[0] / scale[0], 0, x], [0, focal[-1] / scale[1], y], [0, 0, 1]])


def _fundamental(a: CameraPose, b: CameraPose, k0: np.ndarray, k1: np.ndarray) -> np.ndarray:
    pose = b.rotation @ a.rotation.T, b.rotation @ (a.centre - b.centre)
    f = fundamental_matrix(*(jnp.asarray(x, jnp.float32) for x in (k0, k1, *pose)))
    return np.asarray(f / jnp.linalg.norm(f), np.float64)


def split(images: Sequence[ImageFile]) -> tuple[list[ImageFile], list[ImageFile]]:
    """Split photos into those to train on and those held out.

    The split depends on the content of the photos, not on their names or order. Raises UserError if
    there are fewer than two different photos.
    """
    different = sorted({image.sha256: image for image in images}.values(), key=lambda i: i.sha256)
    if len(different) < 2:
        raise UserError(
            f"--images: at least 2 different photos are needed, one of them to measure on; "
            f"got {len(different)}"
        )
    held_out = different[::HELD_OUT]
    return [image for image in different if image not in held_out], held_out


class Crops:
    """Random crops of photos, `side` pixels a side.

    Those of a step depend on the photos, the seed and the step alone.
    """

    def __init__(self, images: Sequence[ImageFile], *, side: int, seed: int) -> None:
        self._images = list(images)
        self._side, self._seed = side, seed
        self._read = functools.lru_cache(maxsize=DECODED)(self._decode)

    def _decode(self, index: int) -> np.ndarray:
        rgb = read_image(self._images[index], max_size=MAX_SIZE).rgb
        # Smaller photos are mirrored and not enlarged, because an enlarged photo has no fine detail
        # that could be found again.
        missing = [max(0, self._side - length) for length in rgb.shape[:2]]
        return np.pad(rgb, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="symmetric")

    def draw(self, step: int, count: int) -> np.ndarray:
        """Draw the crops of a step, float32 (count, side, side, 3), RGB in 0 .. 255."""
        rng = np.random.default_rng([self._seed, step])
        crops = np.empty((count, self._side, self._side, 3), np.float32)
        for crop in crops:
            photo = self._read(int(rng.integers(len(self._images))))
            y, x = (int(rng.integers(length - self._side + 1)) for length in photo.shape[:2])
            crop[:] = photo[y : y + self._side, x : x + self._side]
            if rng.random() < 0.5:
                crop[:] = crop[:, ::-1].copy()
        return crops
