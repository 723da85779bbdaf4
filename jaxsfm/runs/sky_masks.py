"""Masks of the sky, for a run in which something speaks against the model.

Outlines before the sky look alike from several sides of a building. On *statue*, 135 photos of four
sides, the largest model has 55 photos, of which 50 are right. With the sky masked it has 95, of
which 91 are right (docs/decisions/repeated-structure.md).
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.masked_images import with_mask
from jaxsfm.io.masks import mask_path
from jaxsfm.io.sky import below_sky

SHARE, MOST = 0.05, 0.95
"""A photo gets a mask if the sky covers more of it than the first share and less than the second.
"""
COMMON = 0.5
"""Masks are tried if so large a share of the photos gets one."""


def sky_masks(images: Iterable[ImageFile]) -> dict[str, bytes]:
    """Masks that leave out the sky, as PNG files, by the names of the photos that show it.

    There are none if few photos show the sky, or if a photo has a mask of the user's. A photo that
    cannot be decoded gets no mask.
    """
    images = list(images)
    if any(image.mask for image in images):
        return {}
    masks = {image.name: data for image in images if (data := _mask(image)) is not None}
    return masks if len(masks) >= COMMON * len(images) else {}


def without_sky(
    images: Iterable[ImageFile], masks: Mapping[str, bytes], folder: Path
) -> dict[str, ImageFile]:
    """Those of the photos that have masks, with these, by name.

    Args:
      masks: what `sky_masks` returned.
      folder: for the masks; it is made anew.
    """
    with atomic_folder(folder) as fresh:
        for name, data in masks.items():
            path = mask_path(fresh, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    return {i.name: with_mask(i, mask_path(folder, i.name)) for i in images if i.name in masks}


def _mask(image: ImageFile) -> bytes | None:
    """The mask of a photo as a PNG file, which is small; None if it gets none."""
    try:
        used = below_sky(image)
    except ImageError:  # a photo in no pair may never have been decoded
        return None
    if not SHARE < (~used).mean() < MOST:
        return None
    written, data = cv2.imencode(".png", used.astype(np.uint8) * 255)
    assert written
    return data.tobytes()
