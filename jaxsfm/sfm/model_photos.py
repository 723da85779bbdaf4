"""The photos of a given model, some of which may be missing or unreadable."""

import functools
import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.images import (
    ImageError,
    ImageFile,
    WorkingImage,
    inspect_image,
    named,
    shown_name,
    size_and_scale,
)
from jaxsfm.io.photos import GRAYS, Photos, intensities

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")


class ModelPhotos:
    """The photos of the images with a pose, by name, as stored.

    A photo that cannot be read is grey all over. In such an image nothing can be aligned, so it
    keeps its observations of the points that remain, as a night photo does.
    """

    def __init__(self, model: "pycolmap.Reconstruction", folder: Path, config: Config) -> None:
        """Find the photos, and check their sizes.

        Args:
          folder: an image's name is a path below it.
          config: `max_size` limits the working images.

        Raises:
          UserError: the folder is missing or has fewer than two of the photos, or a photo has
            another size than its camera.
        """
        if not folder.is_dir():
            raise UserError(f"--images {folder}: no such folder")
        self.unread: dict[str, str] = {}
        """Name -> why the photo cannot be read."""
        self._sizes: dict[str, tuple[int, int]] = {}
        self._limit = config.max_size
        files = []
        for image_id in sorted(model.reg_image_ids()):
            image = model.image(image_id)
            camera = model.camera(image.camera_id)
            self._sizes[image.name] = camera.width, camera.height
            try:
                file = inspect_image(folder / image.name, name=image.name)
            except ImageError as error:
                self.unread[image.name] = str(error)
                continue
            _check_size(file, self._sizes[image.name], folder)
            files.append(file)
        if len(files) < 2:
            raise UserError(
                f"--images {folder}: {len(files)} of the model's {len(self._sizes)} photos can be "
                f"read there, and a refinement needs two; missing: {named([*self.unread])}"
            )
        for reason in self.unread.values():
            logger.warning("%s; its observations are not aligned", reason)
        self._photos = Photos(files, config)
        # The cache belongs to the object, so that its images go when the object goes.
        self.gray = functools.lru_cache(maxsize=GRAYS)(self._gray)

    def rgb(self, name: str) -> WorkingImage:
        """Colours uint8 (h, w, 3) of the working image; original pixels per working pixel.

        Raises:
          ImageError: the photo cannot be read.
        """
        if name in self.unread:
            raise ImageError(self.unread[name])
        return self._photos.rgb(name)

    def _gray(self, name: str) -> tuple[np.ndarray, tuple[float, float]]:
        """Intensities float32 (h, w) of the working image; original pixels per working pixel."""
        try:
            image = self.rgb(name)
        except ImageError as error:
            if name not in self.unread:
                self.unread[name] = str(error)
                logger.warning("%s; its observations are not aligned", error)
            (width, height), scale = size_and_scale(self._sizes[name], self._limit)
            return np.zeros((height, width), np.float32), scale
        return intensities(image), image.scale


def _check_size(file: ImageFile, size: tuple[int, int], folder: Path) -> None:
    """Raise UserError if a photo has another size than its camera."""
    if file.size == size:
        return
    if file.size == size[::-1]:
        help = "the model was made of photos that had been turned upright; give those"
    else:
        help = "give the photos that the model was made of"
    raise UserError(
        f"--images {folder}: {shown_name(file.name)} has {file.size[0]} x {file.size[1]} pixels, "
        f"but its camera in the model has {size[0]} x {size[1]}; {help}"
    )
