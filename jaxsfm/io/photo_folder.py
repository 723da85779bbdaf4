"""The image files in a folder."""

import logging
import os
from pathlib import Path

from jaxsfm.errors import UserError
from jaxsfm.io import decoders
from jaxsfm.io.images import named

logger = logging.getLogger(__name__)

SUFFIXES = frozenset(
    (*".jpg .jpeg .jpe .png .tif .tiff .bmp .webp .ppm .pgm .jp2".split(), *decoders.SUFFIXES)
)


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

    names = []
    for root, folders, files in os.walk(folder, onerror=unreadable):
        folders[:] = [name for name in folders if not name.startswith(".")]
        names += [
            (Path(root) / name).relative_to(folder).as_posix()
            for name in files
            if Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")
        ]
    if not names:
        suffixes = ", ".join(sorted(SUFFIXES))
        raise UserError(f"{folder}: there are no images in this folder (looked for {suffixes})")
    return _without_doubles(sorted(names))


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
