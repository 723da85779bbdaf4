"""The refinement of a model that another tool has made, from its photos and in its frame."""

import dataclasses
import functools
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.given_model import has_rigs, updated
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.other_camera import other_camera
from jaxsfm.colmap.poses import Poses, model_poses
from jaxsfm.colmap.reconstruction import colour_points, move_model
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
from jaxsfm.sfm.evaluation import align
from jaxsfm.sfm.refine.one_pass import PassSettings
from jaxsfm.sfm.refine.passes import RefinementFigures, refine_model, working_sizes

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

GOOD_ERROR_PX = 1.0
"""The alignment starts at working size if the median reprojection error is smaller than about 1.4
times this, working pixels."""
MAX_OCTAVE = 3
"""It starts at an eighth of the working size at most."""
STAYED, ROUNDS = 2 / 3, 10
"""The share of the cameras that say where the model lies, and how often it is chosen anew which.
The others moved most: their poses were wrong, and must not turn the model when they are
corrected."""


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


class GivenRefinement(NamedTuple):
    """The outcome of the refinement of a given model."""

    model: "pycolmap.Reconstruction"
    """It lies where the given model did."""
    figures: RefinementFigures


def refine_given(
    given: "pycolmap.Reconstruction",
    photos: ModelPhotos,
    settings: PassSettings,
    *,
    on_pass: Callable[[], None] = lambda: None,
) -> GivenRefinement | None:
    """Refine a model that another tool has made; None if too little agrees with the photos.

    Args:
      given: `jaxsfm.colmap.given_model.read_given_model` has read it. It is not changed.
      settings: of the passes. With one thread the model is repeatable to the last byte.
    """
    refined, figures = refine_model(
        given,
        photos.gray,
        settings,
        described_px=_described_px(given, photos),
        on_pass=on_pass,
    )
    if not figures.confirmed:
        return None
    colour_points(refined, photos.rgb)
    model, threads = updated(given, refined), settings.threads
    refines = settings.refine_intrinsics
    if has_rigs(model):
        bundle_adjust(model, loss_px=1.0, refine_intrinsics=refines, threads=threads)
    move_back(model, model_poses(given))
    if not refines:
        figures = dataclasses.replace(figures, camera=other_camera(model, threads=threads))
    return GivenRefinement(model, figures)


def _described_px(given: "pycolmap.Reconstruction", photos: ModelPhotos) -> int:
    """The size of a pixel at which the alignment starts, a power of two of working pixels.

    It is about the median error of the observations, so that the model puts points within the
    reach of the alignment.
    """
    errors = Model.from_colmap(given, working_sizes(given, photos.gray)).errors_px()
    octave = round(math.log2(max(1.0, float(np.median(errors)) / GOOD_ERROR_PX)))
    return 2 ** min(octave, MAX_OCTAVE)


def move_back(model: "pycolmap.Reconstruction", before: Poses) -> None:
    """Move a model so that its cameras lie as they did before, in place. New cameras do not count.

    Bundle adjustment holds one camera, and the others turn about it. What else the user has in the
    frame of the given model, such as a mesh or a georeference, shall still fit. Cameras on one line
    do not say how the model lies; then it stays.
    """
    after = model_poses(model)
    names = sorted(after.keys() & before.keys())
    own = np.asarray([after[name].centre for name in names])
    wanted = np.asarray([before[name].centre for name in names])
    count = max(3, math.ceil(STAYED * len(names)))
    try:
        found = align(own, wanted)
        for _ in range(ROUNDS):
            at = found.scale * own @ found.rotation.T + found.translation
            nearest = np.argsort(np.linalg.norm(at - wanted, axis=1), kind="stable")[:count]
            found = align(own[nearest], wanted[nearest])
    except UserError:
        return
    move_model(model, found.scale, found.rotation, found.translation)
