"""The search for the scale and the turn between two photos.

The network knows neither scale nor rotation. Features are made at several sizes of a photo anyway,
so a photo that shows things twice as large is matched at half its size, without describing anything
again. Turned photos have to be described again; half the size is enough to see whether they match.
"""

from collections.abc import Iterator

import numpy as np

from jaxsfm.config import Config
from jaxsfm.core.octaves import smaller
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import ImageFile
from jaxsfm.io.photo_views import PhotoView, read_view
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import describe_pixels
from jaxsfm.sfm.two_photos.look import Look, look

OCTAVES = ((0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1))
"""The octaves of the first and of the second photo that are matched: relative scales of 2, 1/2, 4
and 1/4, and 2 and 1/2 once more at half the size, where noise and another sensor disturb less."""
LEAST_CELLS = 3
"""Coarse cells along the shorter side: one window of the coarse-to-fine step."""
TURNED_SIZE = 800
"""The longer side of a turned photo, pixels."""
TURNED_OCTAVES = (0, 1, 2)
"""The octaves of the first photo that a turned second photo is matched with."""


def at_octave(features: ImageFeatures, octave: int, *, config: Config) -> ImageFeatures:
    """The features of a photo whose working image is 1 / 2^`octave` times as large."""
    x, y = features.scale
    return features._replace(
        scale=(x * 2**octave, y * 2**octave),
        dense=smaller(features.dense, octave, fine_stride=config.fine_stride),
    )


def at_other_scales(
    features0: ImageFeatures, features1: ImageFeatures, *, config: Config, seed: int
) -> Iterator[Look]:
    """Looks at two photos at other relative scales; none if the features have a single octave."""
    images = (features0.image, features1.image)
    for octave0, octave1 in OCTAVES:
        if max(octave0, octave1) >= config.octaves:
            continue
        side0 = at_octave(features0, octave0, config=config)
        side1 = at_octave(features1, octave1, config=config)
        if all(min(side.dense.coarse_grid) >= LEAST_CELLS for side in (side0, side1)):
            yield look(side0, side1, images, config=config, seed=seed)


def turned_view(image: ImageFile, quarters: int) -> PhotoView:
    """The whole upright photo after quarter turns clockwise, of at most `TURNED_SIZE`."""
    width, height = image.upright_size
    factor = min(TURNED_SIZE / max(width, height), 1.0)
    turns = np.eye(3)
    for _ in range(quarters % 4):  # (x, y) of a photo of `height` rows becomes (height - 1 - y, x)
        turns = np.asarray([[0, -1, height - 1], [1, 0, 0], [0, 0, 1.0]]) @ turns
        width, height = height, width
    shift = 0.5 * factor - 0.5
    zoom = np.asarray([[factor, 0, shift], [0, factor, shift], [0, 0, 1.0]])
    return PhotoView(zoom @ turns, (round(width * factor), round(height * factor)))


def turned(
    weights: Weights, features0: ImageFeatures, image1: ImageFile, *, config: Config, seed: int
) -> Iterator[Look]:
    """Looks at two photos, the second one turned by one, two and three quarter turns."""
    for quarters in (1, 2, 3):
        view = turned_view(image1, quarters)
        seen = describe_view(weights, image1, view, config=config)
        for octave in TURNED_OCTAVES[: config.octaves]:
            side = at_octave(features0, octave, config=config)
            if min(side.dense.coarse_grid) >= LEAST_CELLS:
                images = (features0.image, image1)
                yield look(side, seen, images, views=(None, view), config=config, seed=seed)


def describe_view(
    weights: Weights, image: ImageFile, view: PhotoView, *, config: Config
) -> ImageFeatures:
    """The features of a view; coordinates are those of the view."""
    return describe_pixels(weights, view.as_photo(image), read_view(image, view), config=config)
