"""A finished run, read from its folder again: to be shown, extended or used for localization."""

import dataclasses
import functools
import logging
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from jaxsfm.colmap.model import Model, Sizes, point_colours
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import Poses, model_poses, read_poses
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io import orientation
from jaxsfm.io.entries import RECORD
from jaxsfm.io.images import (
    ImageError,
    ImageFile,
    WorkingImage,
    inspect_image,
    read_image,
    size_and_scale,
)
from jaxsfm.io.masks import MaskFile, mask_path, mask_size
from jaxsfm.io.photo_folder import mask_of, with_mask
from jaxsfm.io.store import Store
from jaxsfm.report.run_inputs import RecordedConfig, RunIdentity
from jaxsfm.report.run_report import RunReport, read_report
from jaxsfm.report.run_results import EvaluationReport
from jaxsfm.report.typed_json import to_json
from jaxsfm.sfm.evaluation import Similarity, common_alignment, evaluate, of_photos

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger(__name__)

ORIGINAL = (2**31, 1.0)
"""The limits of `jaxsfm.io.images.working_size` that leave every photo as it is."""


class ReferencePoses(NamedTuple):
    """Reference poses, and how the model is moved onto them."""

    poses: Poses
    similarity: Similarity
    """From the model to the reference."""


class RecordedPhotos:
    """The photos of a run, for as long as they are unchanged and where the run found them."""

    def __init__(
        self,
        folder: Path | None,
        identity: RunIdentity,
        config: RecordedConfig,
        masks: Path | None,
    ) -> None:
        """The photos of the identity, which lie in `folder`, and their masks, in `masks`."""
        self.folder = folder
        self._hashes, self._identity, self._masks = identity.images, identity, masks
        self._config = config
        self.read = functools.lru_cache(maxsize=16)(self._read)
        self.taken_with = functools.cache(self._taken_with)

    def file(self, name: str) -> ImageFile | None:
        """The file of a photo; None if it is gone or has changed."""
        if self.folder is None:
            return None
        try:
            image = inspect_image(self.folder / name, name=name)
        except ImageError:
            return None
        return self.as_described(image) if image.sha256 == self._hashes.get(name) else None

    def as_described(self, image: ImageFile) -> ImageFile:
        """The file of a photo of the run, turned and masked as it was when it was described."""
        code = orientation.checked(self._identity.orientations.get(image.name))
        return dataclasses.replace(image, orientation=code, mask=self._mask(image.name))

    def _taken_with(self, name: str) -> str:
        """What EXIF says of the camera of a photo; empty if nothing, or if the file is gone."""
        image = self.file(name)
        return "" if image is None else image.taken_with

    def with_own_mask(self, image: ImageFile) -> ImageFile:
        """A new photo with its mask, if there is one among the run's masks.

        Raises UserError if the mask cannot be used.
        """
        masks = self._masks
        if masks is None:
            return with_mask(image, None)
        one = mask_size(masks) if masks.is_file() else None
        return with_mask(image, mask_of(image, masks, one))

    def _mask(self, name: str) -> MaskFile | None:
        sha256 = self._identity.masks.get(name)
        return None if sha256 is None else MaskFile(mask_path(self._masks or Path(), name), sha256)

    def recorded(self, name: str) -> ImageFile:
        """The file of a photo as the run found it, unseen: it may be gone. Its size is (0, 0)."""
        path = (self.folder or Path()) / name
        return self.as_described(
            ImageFile(name=name, path=path, size=(0, 0), sha256=self._hashes[name])
        )

    def name_of(self, sha256: str) -> str | None:
        """The name of the photo with that content; None if the run has no such photo."""
        return next((name for name, each in self._hashes.items() if each == sha256), None)

    def _read(self, name: str) -> WorkingImage | None:
        """The working image of a photo; None if it is gone, changed or cannot be decoded."""
        image, config = self.file(name), self._config
        try:
            return image and read_image(image, max_size=config.max_size, enlarge=config.enlarge)
        except ImageError:
            return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """What the folder of a run holds."""

    folder: Path
    """The folder of its results."""
    report: RunReport
    """The content of report.json; its `evaluation` is against `reference`."""
    photos: RecordedPhotos
    model: Model | None
    """The best model, in original pixels."""
    colours: np.ndarray
    """uint8 (n, 3): RGB of each point of the model."""
    reference: ReferencePoses | None
    store: Store
    """The features and matches that the folder keeps."""
    matches: Store
    """The run's matches."""

    @functools.cached_property
    def errors(self) -> np.ndarray:
        """float64 (m,): the reprojection error of each observation, original pixels."""
        return self.model.errors_px() if self.model is not None else np.zeros(0)

    @property
    def config(self) -> Config:
        """The config of the run; UserError if it has fields that this version does not know."""
        recorded = self.report.options["config"]
        try:
            found = msgspec.convert(recorded, Config)
            if not _has_keys(to_json(found), recorded):
                raise ValueError("an option is not known")
        except ValueError as error:
            raise UserError(
                f"{self.folder}: was made by jaxsfm {self.report.version}, whose options "
                "this version does not know; run reconstruct again"
            ) from error
        return found


def _has_keys(known: object, recorded: object) -> bool:
    """Whether all keys of nested dictionaries are known."""
    if not isinstance(known, dict) or not isinstance(recorded, dict):
        return True
    return all(key in known and _has_keys(known[key], recorded[key]) for key in recorded)


def sizes_within(reconstruction: "pycolmap.Reconstruction", max_size: int, enlarge: float) -> Sizes:
    """The working sizes of a model's images, for limits as in `jaxsfm.io.images.working_size`."""
    sizes = {}
    for image in reconstruction.images.values():
        camera = reconstruction.camera(image.camera_id)
        sizes[image.name] = size_and_scale((camera.width, camera.height), max_size, enlarge)
    return sizes


def _with_reference(
    report: RunReport, poses: Poses, given: Path | None
) -> tuple[RunReport, ReferencePoses | None]:
    """The reference poses, and the report with the errors against them.

    Args:
      given: reference poses that the user named. They must be readable. Those that the run was
        given may be gone, which is only a warning.
    """
    recorded = report.known_options.reference
    path = given or (None if recorded is None else Path(recorded))
    if path is None:
        return report, None
    try:
        reference = read_poses(path)
        _, _, similarity = common_alignment(poses, reference)
        evaluation = evaluation_report(poses, of_photos(reference, report.photos()))
    except UserError as error:
        if given is not None:
            raise
        logger.warning("the reference poses of the run are not shown: %s", error)
        return report, None
    report = dataclasses.replace(report, evaluation=evaluation)
    return report, ReferencePoses(reference, similarity)


def evaluation_report(
    poses: Poses, reference: Poses, *, align_on: Collection[str] | None = None
) -> EvaluationReport:
    """The errors of a model's poses. Arguments and errors are those of `evaluate`."""
    found = evaluate(poses, reference, align_on=align_on)
    return msgspec.convert(found.as_dict(), EvaluationReport)


def masks_folder(report: RunReport) -> Path | None:
    """The folder of the run's masks, or the file of its one mask."""
    folder = report.options.get("masks")
    return Path(folder) if isinstance(folder, str) else None


def _matches_of(store: Store, report: RunReport) -> Store:
    """Where the matches of a run are; `store` has those at the size of its config."""
    identity, low_resolution = report.identity, report.low_resolution
    if low_resolution is None or low_resolution.whole:
        return store
    first = dataclasses.replace(identity, config=identity.config | {"max_size": low_resolution.px})
    return Store(store.path, to_json(first))


def read_run(
    folder: Path, *, images: Path | None = None, reference: Path | None = None
) -> FinishedRun:
    """Read the results of a run.

    Args:
      folder: the OUT of a run, or OUT/failed.
      images: the folder of the photos; default: where the run found them.
      reference: reference poses to compare with; default: those of the run.

    Raises:
      UserError: there is no finished run, or an argument cannot be used.
    """
    report = read_report(folder)
    if images is not None and not images.is_dir():
        raise UserError(f"--images {images}: no such folder")
    home = folder if (folder / RECORD).exists() else folder.parent
    recorded = report.images.folder
    where = images or (Path(recorded) if recorded else None)
    model, known, colours = None, None, np.zeros((0, 3), np.uint8)
    if report.models and (folder / "sparse" / "0").is_dir():
        found = read_model(folder / "sparse" / "0")
        model = Model.from_colmap(found, sizes_within(found, *ORIGINAL))
        colours = point_colours(found)
        report, known = _with_reference(report, model_poses(found), reference)
    elif reference is not None:
        raise UserError(f"--reference {reference}: {folder} has no model to compare with it")
    store = Store(home, to_json(report.identity))
    return FinishedRun(
        folder=folder,
        report=report,
        photos=RecordedPhotos(
            where, report.identity, report.known_options.config, masks_folder(report)
        ),
        model=model,
        colours=colours,
        reference=known,
        store=store,
        matches=_matches_of(store, report),
    )
