"""The image files in a folder, and their masks in another one."""

import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Iterable, Mapping, Set
from pathlib import Path

from jaxsfm.errors import UserError
from jaxsfm.io import decoders
from jaxsfm.io.images import ImageFile, named
from jaxsfm.io.masks import mask_path, mask_size, open_mask

logger = logging.getLogger(__name__)

SUFFIXES = frozenset(
    (*".jpg .jpeg .jpe .png .tif .tiff .bmp .webp .ppm .pgm .jp2".split(), *decoders.SUFFIXES)
)

VIDEOS = frozenset(".mp4 .mov .m4v .avi .mkv .webm .mts .m2ts .mpg .mpeg .wmv .3gp".split())
"""The suffixes of files that are videos; one is only told about, so no other one is needed."""


def find_videos(folder: Path) -> list[str]:
    """The names of the video files in a folder and its sub-folders, sorted, without hidden ones."""
    return _files(folder, VIDEOS)


def find_images(folder: Path) -> list[str]:
    """The names of the image files in a folder and its sub-folders, sorted, without hidden ones.

    Cameras and phones store a photo in two formats, and people convert photos. Of files that differ
    in their suffix alone, a RAW file is left out if there is another one, and a HEIC or AVIF file
    if there is one in a usual format.

    Raises:
      UserError: there is no such folder, it cannot be read, or it holds no images.
    """
    try:
        if not folder.exists():
            raise UserError(f"{folder}: no such folder")
        if not folder.is_dir():
            raise UserError(f"{folder}: not a folder")
        os.listdir(folder)
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror})") from error

    def unreadable(error: OSError) -> None:
        logger.warning("%s: skipped, cannot be read (%s)", error.filename, error.strerror)

    names = _files(folder, SUFFIXES, unreadable)
    if not names:
        suffixes = ", ".join(sorted(SUFFIXES))
        raise UserError(f"{folder}: there are no images in this folder (looked for {suffixes})")
    return _without_doubles(names)


def _files(
    folder: Path, suffixes: Set[str], onerror: Callable[[OSError], None] | None = None
) -> list[str]:
    """The names of the files with such suffixes, sorted, without hidden ones.

    Args:
      onerror: is told of each sub-folder that cannot be read.
    """
    names = []
    for root, folders, files in os.walk(folder, onerror=onerror):
        folders[:] = [name for name in folders if not name.startswith(".")]
        names += [
            (Path(root) / name).relative_to(folder).as_posix()
            for name in files
            if Path(name).suffix.lower() in suffixes and not name.startswith(".")
        ]
    return sorted(names)


def _without_doubles(names: list[str]) -> list[str]:
    rank = {name: decoders.RANK[decoders.SUFFIXES.get(Path(name).suffix.lower())] for name in names}
    least: dict[str, int] = {}
    for name in names:
        stem = name.removesuffix(Path(name).suffix)
        least[stem] = min(rank[name], least.get(stem, rank[name]))
    doubles = [n for n in names if rank[n] > least[n.removesuffix(Path(n).suffix)]]
    if doubles:
        logger.info("left out, as the same photo is there in another format: %s", named(doubles))
    return sorted({*names} - {*doubles})


def too_few(folder: Path, usable: int, skipped: Mapping[str, str]) -> str:
    """What to tell the user if a folder has fewer than two usable images.

    Args:
      skipped: why others cannot be used, by name.
    """
    why = f"; skipped: {next(iter(skipped.values()))}" if skipped else ""
    return f"{folder}: {usable} usable images, at least 2 are needed{why}"


def masks_of(images: Iterable[ImageFile]) -> dict[str, str]:
    """The SHA-256 of the images' masks, by the names of the images."""
    return {image.name: image.mask.sha256 for image in images if image.mask is not None}


def with_masks(images: Iterable[ImageFile], masks: Path) -> tuple[list[ImageFile], list[str]]:
    """The images with their masks, and the names of those that have none.

    Of a photo without a mask, all pixels but a blank border are used.

    Args:
      masks: a folder with the masks of the images, or the file of one mask for all images that have
        its size.

    Raises:
      UserError: there is no such folder or file, it has no mask of any image, or a mask cannot be
        used.
    """
    if not masks.exists():
        raise UserError(f"--masks {masks}: no such folder or file")
    images = list(images)
    one = mask_size(masks) if masks.is_file() else None
    found = {image.name: mask_of(image, masks, one) for image in images}
    bare = [name for name, path in found.items() if path is None]
    if len(bare) == len(images):
        its = f"would be {mask_path(Path(), bare[0])}" if masks.is_dir() else "has another size"
        raise UserError(f"--masks {masks}: no mask of any photo (the mask of {bare[0]} {its})")
    opened = functools.cache(open_mask)  # one file for all images is decoded once
    masked = (
        (image, None if (path := found[image.name]) is None else opened(path, image.size))
        for image in images
    )
    return [dataclasses.replace(image, mask=mask) for image, mask in masked], bare


def mask_of(image: ImageFile, masks: Path, one: tuple[int, int] | None) -> Path | None:
    """Where the mask of an image lies; None if it has none.

    Args:
      masks: as `with_masks` takes it.
      one: (width, height) of the one mask for all images; None: they are in a folder.
    """
    path = mask_path(masks, image.name)
    return path if one in (None, image.size) and path.is_file() else None


def with_mask(image: ImageFile, path: Path | None) -> ImageFile:
    """The image with the mask at a path, if there is one; UserError if it cannot be used."""
    mask = None if path is None else open_mask(path, image.size)
    return dataclasses.replace(image, mask=mask)
