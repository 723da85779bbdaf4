"""What `localize` and `extend` need of a finished run: its models, its cameras, its weights, and
its photos, of which those that look most similar are matched with a new one.
"""

import contextlib
import functools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from jaxsfm.colmap.cameras import Cameras, estimated_camera
from jaxsfm.colmap.intrinsics import KnownCameras
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.view import View
from jaxsfm.config import Config
from jaxsfm.core.retrieval import TIE
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile, shown_name, size_and_scale
from jaxsfm.io.photos import Pixels
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights, chosen_weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.global_descriptors import GEM
from jaxsfm.matching.retrieval import describe_photos
from jaxsfm.options import WeightsChoice
from jaxsfm.report.finished_run import FinishedRun, sizes_within
from jaxsfm.report.run_inputs import UsedWeights

if TYPE_CHECKING:
    import pycolmap

Shortlist = Callable[[ImageFile, Sequence[str]], Sequence[str]]
"""From a photo and the names of other photos to the names of those that it is matched with."""


class WorkingModel(NamedTuple):
    """A model of a run in working pixels, and the settings of the run."""

    model: Model
    config: Config
    seed: int

    @property
    def views(self) -> Sequence[View]:
        """The views of the model."""
        return self.model.views


class CameraPrior(NamedTuple):
    """What is known of a photo's camera before the photo is localized."""

    camera: "pycolmap.Camera"
    source: str
    """Where it comes from: `given`, `run`, `exif` or `guess`."""

    @property
    def estimated(self) -> bool:
        """Whether localization estimates the focal length."""
        return self.source in ("exif", "guess")


def read_working_model(folder: Path, config: Config, *, seed: int = 0) -> WorkingModel:
    """Read a COLMAP model into working pixels; UserError if `folder` has no readable model."""
    model = read_model(folder)
    sizes = sizes_within(model, config.max_size, config.enlarge)
    return WorkingModel(Model.from_colmap(model, sizes), config, seed)


def read_working_models(run: FinishedRun) -> list[WorkingModel]:
    """All models of a run, the first one first; UserError if one is missing or cannot be read."""
    config, seed = run.config, run.report.known_options.seed
    return [
        read_working_model(run.folder / "sparse" / str(k), config, seed=seed)
        for k in range(len(run.report.models))
    ]


def camera_priors(
    image: ImageFile,
    models: Sequence[WorkingModel],
    intrinsics: KnownCameras | None,
    taken_with: Callable[[str], str] = lambda _: "",
) -> list[CameraPrior]:
    """The camera that a photo starts with in each model (`camera_prior`).

    What is known is asked of all models together, so it is the same in all of them. But each model
    has refined the cameras of the run for itself, and a photo starts with those of the model.
    """
    views = {view.name: view for model in reversed(models) for view in model.views}
    prior = camera_prior(image, list(views.values()), intrinsics, taken_with)
    if prior.source != "run":
        return [prior] * len(models)
    own = [{view.camera.camera_id: view.camera for view in model.views} for model in models]
    number = prior.camera.camera_id
    return [prior._replace(camera=cameras.get(number, prior.camera)) for cameras in own]


def camera_prior(
    image: ImageFile,
    views: Sequence[View],
    intrinsics: KnownCameras | None,
    taken_with: Callable[[str], str] = lambda _: "",
) -> CameraPrior:
    """The camera that a photo starts with.

    It is the given one. Without one, it is the camera of the model, if the model has exactly one
    camera of the photo's size that several views share, and EXIF does not say that the photo was
    taken with another one. Else it comes from EXIF, or is a guess.

    Args:
      taken_with: what EXIF says of the camera of a photo of the model, by name.

    Raises:
      UserError: the given intrinsics do not fit the photo's size.
    """
    if intrinsics is not None:
        known = Cameras(known=intrinsics)
        known.check_fits([image])
        ((camera, _),) = known.assigned([image])
        return CameraPrior(camera, "given")
    fitting = [v for v in views if (v.camera.width, v.camera.height) == image.size]
    count = Counter(view.camera.camera_id for view in fitting)
    shared = {v.camera.camera_id: v for v in fitting if count[v.camera.camera_id] > 1}
    alike = [view for view in shared.values() if taken_with(view.name) == image.taken_with]
    if len(alike) == 1:
        return CameraPrior(alike[0].camera, "run")
    camera = estimated_camera([image])
    return CameraPrior(camera, "exif" if camera.has_prior_focal_length else "guess")


def view_without_pose(image: ImageFile, prior: CameraPrior, config: Config) -> View:
    """The view of a photo that is not localized yet."""
    size, scale = size_and_scale(image.size, config.max_size, config.enlarge)
    return View.without_pose(image.name, 0, prior.camera, size, Pixels(scale))


def weights_of_run(run: FinishedRun, choice: WeightsChoice) -> Weights:
    """Load the weights that a run was made with; UserError if `choice` names others."""
    config = run.config
    weights = chosen_weights(choice, config.backbone)
    made_with, now = run.report.weights, msgspec.convert(weights.described(config), UsedWeights)
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


def photos_of_run(run: FinishedRun, names: Sequence[str]) -> dict[str, ImageFile]:
    """The files of photos of a run, by name; UserError if one is gone or has changed."""
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


def similar_photos(
    run: FinishedRun,
    weights: Weights,
    k: int,
    new: Mapping[str, ImageFile],
    execution: Execution,
) -> Shortlist:
    """A shortlist of the `k` most similar photos of a run; equally similar ones are taken by name.

    Photos are compared by GeM, which describes each photo by itself. The descriptors of the run's
    photos are kept in its folder, if it can be written. The shortlist raises ImageError if the
    photo that it is called with cannot be decoded.

    Args:
      new: photos that are not in the run, by name.

    Raises:
      UserError: k is less than 1.
    """
    if k < 1:
        raise UserError(f"--shortlist must be at least 1; got {k}")

    def describe(image: ImageFile, store: Store | None = None) -> np.ndarray:
        found = describe_photos(weights, [image], kind="gem", store=store, execution=execution)
        for _, error in found.lost:
            raise error
        return found.vectors[image.name]

    @functools.cache
    def descriptor(name: str) -> np.ndarray:
        if name in new:
            return describe(new[name])
        saved = run.store.load_descriptor(run.photos.recorded(name), GEM)
        if saved is not None:
            return saved
        image = photos_of_run(run, [name])[name]
        try:
            return describe(image, run.store)
        except ImageError:
            raise
        except UserError:  # the run's folder cannot be written
            return describe(image)

    def shortlist(image: ImageFile, names: Sequence[str]) -> Sequence[str]:
        if k >= len(names):
            return names
        own, nearness = descriptor(image.name), {}
        for name in names:
            with contextlib.suppress(ImageError):  # the other photo cannot be decoded
                nearness[name] = round(float(descriptor(name) @ own) / TIE)
        return sorted(nearness, key=lambda name: (-nearness[name], name))[:k]

    return shortlist
