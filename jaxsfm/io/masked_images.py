"""Images with their masks."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from jaxsfm.io.images import ImageFile
from jaxsfm.io.masks import mask_path, missing_masks, open_mask


def masks_of(images: Iterable[ImageFile]) -> dict[str, str]:
    """The SHA-256 of the images' masks, by the names of the images."""
    return {image.name: image.mask.sha256 for image in images if image.mask is not None}


def with_masks(images: Iterable[ImageFile], folder: Path) -> tuple[list[ImageFile], list[str]]:
    """The images with their masks, and the names of those that have none.

    Raises:
      UserError: the folder has no mask of any image, or a mask cannot be used.
    """
    images = list(images)
    bare = missing_masks(folder, [image.name for image in images])
    lacking = set(bare)
    masked = [
        image if image.name in lacking else with_mask(image, mask_path(folder, image.name))
        for image in images
    ]
    return masked, bare


def with_mask(image: ImageFile, path: Path | None) -> ImageFile:
    """The image with the mask at a path, if there is one; UserError if it cannot be used."""
    mask = None if path is None else open_mask(path, image.size)
    return dataclasses.replace(image, mask=mask)
