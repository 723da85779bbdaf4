"""What placing photos in a finished run needs of it: its model, weights, photos, and which of them
may show the same as a new one.
"""

import contextlib
import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.colmap.database import camera_for
from jaxsfm.colmap.intrinsics import Intrinsics, check_fits
from jaxsfm.colmap.model_arrays import Tracks, View, read_model_arrays
from jaxsfm.colmap.poses import read_model
from jaxsfm.config import Config
from jaxsfm.core.pooling import TIE
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile, shown_name, working_size
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights, chosen_weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.global_descriptors import GEM
from jaxsfm.matching.retrieval import describe_photos
from jaxsfm.options import WeightsChoice
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.run_inputs import UsedWeights
from jaxsfm.report.typed_json import from_json

Shortlist = Callable[[ImageFile, Sequence[str]], Sequence[str]]
"""A photo and the names of the model's photos -> those that it is matched with."""


class KnownModel(NamedTuple):
    """The best model of a run, in working pixels."""

    views: list[View]
    tracks: Tracks
    config: Config
    seed: int


class ChosenCamera(NamedTuple):
    """A photo's camera before it is localized."""

    camera: Any
    """pycolmap.Camera."""
    source: str
    """given, run, exif or guess."""

    @property
    def own(self) -> bool:
        """Whether its focal length is estimated."""
        return self.source in ("exif", "guess")


def known_model(folder: Path, config: Config, *, seed: int = 0) -> KnownModel:
    """A COLMAP model on disk, seen in the working pixels of a config.

    Raises:
      UserError: no readable model in `folder`.
    """
    model = read_model(folder)
    cameras = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    sizes = {}
    for name, camera in cameras.items():
        width, height = working_size((camera.width, camera.height), config.max_size, config.enlarge)
        sizes[name] = (width, height), (camera.width / width, camera.height / height)
    return KnownModel(*read_model_arrays(model, sizes), config, seed)


def choose_camera(
    image: ImageFile, views: Sequence[View], intrinsics: Intrinsics | None
) -> ChosenCamera:
    """The given camera; else the model's, if exactly one of this size is that of several views;
    else one from EXIF or a guess.

    Raises:
      UserError: the given one does not fit.
    """
    if intrinsics is not None:
        check_fits(intrinsics, {image.name: image.size})
        return ChosenCamera(intrinsics.camera(image.size), "given")
    fitting = [v.camera for v in views if (v.camera.width, v.camera.height) == image.size]
    count = Counter(camera.camera_id for camera in fitting)
    shared = {c.camera_id: c for c in fitting if count[c.camera_id] > 1}
    if len(shared) == 1:
        (camera,) = shared.values()
        return ChosenCamera(camera, "run")
    camera = camera_for(image, None)
    return ChosenCamera(camera, "exif" if camera.has_prior_focal_length else "guess")


def view_of(image: ImageFile, chosen: ChosenCamera, config: Config) -> View:
    """A photo that has no pose yet."""
    width, height = working_size(image.size, config.max_size, config.enlarge)
    return View(
        image_id=0,
        name=image.name,
        rotation=np.eye(3),
        centre=np.zeros(3),
        camera=chosen.camera,
        scale=np.asarray([image.size[0] / width, image.size[1] / height]),
        size=(width, height),
    )


def run_weights(run: FinishedRun, choice: WeightsChoice) -> Weights:
    """Those of the run, or UserError."""
    config = run.config
    weights = chosen_weights(choice, config.backbone)
    made_with, now = run.report.weights, from_json(UsedWeights, weights.described(config))
    for used, here, option in (
        (made_with.sha256, now.sha256, "--weights"),
        (made_with.relocalizer_sha256, now.relocalizer_sha256, "--relocalizer"),
    ):
        if used != here:
            raise UserError(
                f"{run.folder}: was made with other weights (SHA-256 {str(used)[:12]}..., not "
                f"{str(here)[:12]}...); give them with {option}"
            )
    return weights


def run_files(run: FinishedRun, names: Sequence[str]) -> dict[str, ImageFile]:
    """The run's photos, or UserError for one that is gone."""
    files = {}
    for name in names:
        image = run.photos.file(name)
        if image is None:
            raise UserError(
                f"{shown_name(name)}: gone or changed since the run (looked in "
                f"{run.photos.folder}); say where the run's photos are with --images"
            )
        files[name] = image
    return files


def by_similarity(
    run: FinishedRun, weights: Weights, k: int, new: Mapping[str, ImageFile], execution: Execution
) -> Shortlist:
    """The `k` most similar photos by GeM, which describes each photo by itself; equally similar
    ones by name. The run's photos are described once and kept in its folder, if it can be written.

    Args:
      new: photos that the run does not know, by name.

    The shortlist raises ImageError for a photo that cannot be decoded.

    Raises:
      UserError: k is less than 1.
    """
    if k < 1:
        raise UserError(f"--shortlist must be at least 1; got {k}")

    def describe(images: Sequence[ImageFile], store: Store) -> dict[str, np.ndarray]:
        found = describe_photos(weights, images, kind="gem", store=store, execution=execution)
        for _, error in found.lost:
            raise error
        return found.vectors

    def described_apart(image: ImageFile) -> np.ndarray:
        with tempfile.TemporaryDirectory(prefix="jaxsfm-") as scratch:
            store = Store(Path(scratch), run.report.identity.to_json())
            return describe([image], store)[image.name]

    @functools.cache
    def of(name: str) -> np.ndarray:
        if name in new:
            return described_apart(new[name])
        unread = run.photos.recorded(name)
        kept = run.matches.load_descriptor(unread, GEM)
        if kept is not None and "array" in kept:
            return kept["array"]
        image = run_files(run, [name])[name]
        try:
            return describe([image], run.matches)[name]
        except ImageError:
            raise
        except UserError:  # the run's folder cannot be written
            return described_apart(image)

    def shortlist(image: ImageFile, names: Sequence[str]) -> Sequence[str]:
        if k >= len(names):
            return names
        own, nearness = of(image.name), {}
        for name in names:
            with contextlib.suppress(ImageError):  # another one that cannot be decoded
                nearness[name] = round(float(of(name) @ own) / TIE)
        return sorted(nearness, key=lambda name: (-nearness[name], name))[:k]

    return shortlist
