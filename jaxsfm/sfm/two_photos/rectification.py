"""Both photos as seen from one place.

A first pass finds a rough geometry, if only from a few matches. With it, the part that both photos
show is cut out of them, at one size, and one photo is turned and slanted by the affine map that
leads to the other. The network, which knows neither scale nor rotation, then sees twice the same.
"""

import math
from typing import NamedTuple

import numpy as np

from jaxsfm.io.images import ImageFile
from jaxsfm.io.orientation import to_stored
from jaxsfm.io.photos import PhotoView

SIZE = 1200
"""The longer side of the common view, pixels. Larger ones take longer and find no more
(docs/decisions/hard-pairs.md)."""
SMALL_SIZE = 600
"""The same for views that only tell which of several geometries is true."""
MOST_ENLARGED = 4.0
"""No photo is enlarged more than this to fill the view; beyond, there is nothing to see."""
GROWN = 0.3
"""The view shows the box of the matches and so much of its sides more on each side: the first pass
may have seen only a part of what both photos show."""
MARGIN = 0.025
"""The box grows by this share of the photo's longer side, too, so that a small one does not stay
small."""
OUTLYING = 2.0
"""Per cent of the matches that may lie outside the box on each of its sides."""
MOST_STRETCHED = 8.0
"""A map that stretches one direction so many times as much as another shows nothing."""
RATIOS = (0.5, 0.75, 1.0)
"""The shorter side of a view as a share of the longer one. The box grows to the next of them,
because each other size of a view would be another program to compile."""
ROUNDS = 20
"""Rounds of the robust fit; its weights are then settled."""


class Located(NamedTuple):
    """The matches that determine a common view, in pixels of the upright photos."""

    xy0: np.ndarray
    """float64 (n, 2)."""
    xy1: np.ndarray


def upright(xy: np.ndarray, image: ImageFile) -> np.ndarray:
    """Points (n, 2) of the stored photo, in pixels of the upright one, float64."""
    return transformed(np.linalg.inv(to_stored(image.size, image.orientation)), xy)


def transformed(matrix: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Points (n, 2) transformed by an affine matrix (3, 3), float64."""
    return xy.astype(np.float64) @ matrix[:2, :2].T + matrix[:2, 2]


def affine_between(matches: Located) -> np.ndarray | None:
    """The affine map (3, 3) that fits most matches; None if they determine none.

    Least squares, reweighted by Cauchy's loss; its scale is the median error of the round before.
    """
    xy0, xy1 = matches
    if len(xy0) < 3:
        return None
    mean, spread = xy0.mean(axis=0), float(xy0.std()) or 1.0
    rows = np.column_stack([(xy0 - mean) / spread, np.ones(len(xy0))])
    weight, fitted = np.ones(len(xy0)), np.zeros((3, 2))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        fitted = np.linalg.lstsq(rows * root, xy1 * root, rcond=None)[0]
        error = np.linalg.norm(rows @ fitted - xy1, axis=1)
        weight = 1 / (1 + np.square(error / max(float(np.median(error)), 1e-6)))
    matrix = np.eye(3)
    matrix[:2, :2] = fitted[:2].T / spread
    matrix[:2, 2] = fitted[2] - matrix[:2, :2] @ mean
    stretch = np.linalg.svd(matrix[:2, :2], compute_uv=False)
    if np.linalg.det(matrix[:2, :2]) <= 0 or stretch[0] > MOST_STRETCHED * stretch[1]:
        return None
    return matrix


class ViewChange(NamedTuple):
    """How differently two photos show the same: the parts of an affine map."""

    scale: float
    """The largest change of a length in any direction, as a factor of at least 1."""
    turn: float
    """The angle of the turn in the image plane, degrees, 0 to 180."""


def view_change(affine: np.ndarray) -> ViewChange:
    """The parts of an affine map (3, 3): the turn is that of the polar decomposition."""
    u, stretch, vt = np.linalg.svd(affine[:2, :2])
    turn = u @ vt
    angle = abs(math.degrees(math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))
    return ViewChange(float(max(stretch[0], 1 / stretch[1])), angle)


def rectified_views(
    matches: Located, image0: ImageFile, image1: ImageFile, *, size: int = SIZE
) -> tuple[PhotoView, PhotoView] | None:
    """A view of each photo in which matching points lie at about the same pixel; None if the
    matches determine none.

    The photo that shows the common part larger is cut and resized, and the other one is warped to
    it, so that no detail is lost. The views have the same size.

    Args:
      size: the longer side of the views, pixels.
    """
    affine = affine_between(matches)
    if affine is None:
        return None
    larger = int(np.linalg.det(affine[:2, :2]) > 1)
    xy, image = ((matches.xy0, image0), (matches.xy1, image1))[larger]
    frame = _frame(xy, image.upright_size, size)
    to_frame = affine if larger else np.linalg.inv(affine)
    other = PhotoView(frame.matrix @ to_frame, frame.size)
    return (other, frame) if larger else (frame, other)


def _frame(xy: np.ndarray, photo: tuple[int, int], size: int) -> PhotoView:
    """The view of the box around some points of an upright photo of (width, height)."""
    low, high = np.percentile(xy, (OUTLYING, 100 - OUTLYING), axis=0)
    grown = GROWN * (high - low) + MARGIN * max(photo)
    low = np.maximum(low - grown, -0.5)
    high = np.minimum(high + grown, np.asarray(photo) - 0.5)
    centre, sides = (low + high) / 2, high - low
    longer = int(sides[1] > sides[0])
    ratio = min(each for each in RATIOS if each * sides[longer] >= sides[1 - longer])
    canvas = np.full(2, float(size))
    canvas[1 - longer] = round(ratio * size)
    zoom = min(size / float(sides[longer]), MOST_ENLARGED)
    corner = centre - canvas / zoom / 2
    # The corner of the box is the corner of the view's top-left pixel, (-0.5, -0.5).
    matrix = np.asarray(
        [[zoom, 0, -zoom * corner[0] - 0.5], [0, zoom, -zoom * corner[1] - 0.5], [0, 0, 1.0]]
    )
    return PhotoView(matrix, (int(canvas[0]), int(canvas[1])))
