"""A finished run, read from its folder again: to be shown, extended or used for localization."""

import dataclasses
import functools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model, point_colours
from jaxsfm.colmap.poses import Poses, model_poses, read_model, read_poses
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import ImageError, ImageFile, WorkingImage, inspect_image, read_image
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.store import Store
from jaxsfm.io.work_folder import RECORD
from jaxsfm.report.run_inputs import RecordedConfig
from jaxsfm.report.run_report import RunReport, read_report
from jaxsfm.report.run_results import EvaluationReport
from jaxsfm.report.typed_json import from_json, to_json
from jaxsfm.sfm.evaluation import Similarity, common_alignment, evaluate

logger = logging.getLogger(__name__)


class FinishedModel(NamedTuple):
    """The best model of a run, in original pixels (`View.pixels` are theirs)."""

    views: Sequence[View]
    tracks: Tracks
    colours: np.ndarray
    """uint8 (n, 3): RGB of each point."""
    errors: np.ndarray
    """float64 (m,): the reprojection error of each observation, original pixels."""


class ReferencePoses(NamedTuple):
    """Reference poses, and how the model is moved onto them."""

    poses: Poses
    similarity: Similarity
    """From the model to the reference."""


class RecordedPhotos:
    """The photos of a run, for as long as they are unchanged and where the run found them."""

    def __init__(
        self, folder: Path | None, hashes: Mapping[str, str], config: RecordedConfig
    ) -> None:
        """Photos in `folder` with the SHA-256 `hashes` by name."""
        self.folder = folder
        self._hashes = hashes
        self._config = config
        self.read = functools.lru_cache(maxsize=16)(self._read)

    def file(self, name: str) -> ImageFile | None:
        """The file of a photo; None if it is gone or has changed."""
        if self.folder is None:
            return None
        try:
            image = inspect_image(self.folder / name, name=name)
        except ImageError:
            return None
        return image if image.sha256 == self._hashes.get(name) else None

    def recorded(self, name: str) -> ImageFile:
        """The file of a photo as the run found it, unseen: it may be gone. Its size is (0, 0)."""
        path = (self.folder or Path()) / name
        return ImageFile(name=name, path=path, size=(0, 0), sha256=self._hashes[name])

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
    model: FinishedModel | None
    reference: ReferencePoses | None
    matches: Store

    @property
    def config(self) -> Config:
        """The config of the run.

        Raises:
          UserError: the config has fields that this version of jaxsfm does not know.
        """
        try:
            return _config(self.report.options.config)
        except ValueError as error:
            raise UserError(
                f"{self.folder}: was made by jaxsfm {self.report.version}, whose options "
                "this version does not know; run reconstruct again"
            ) from error

    def load_matches(self, pair: Pair) -> PairResult | None:
        """The matches of a pair, original pixels; None if there are none or the file is gone."""
        return self.matches.load_matches(pair)


def _config(recorded: RecordedConfig) -> Config:
    """The config of a run.

    Raises:
      ValueError: it is not one of this version.
    """
    plain = to_json(recorded)
    config = from_json(Config, plain)
    if not _names(plain) <= _names(to_json(config)):
        raise ValueError("the config has fields that this version does not know")
    return config


def _names(value: Json, place: str = "") -> set[str]:
    """The places of all keys in plain JSON."""
    if not isinstance(value, Mapping):
        return {place}
    return set().union(*(_names(each, f"{place}.{key}") for key, each in value.items()))


def _model(folder: Path) -> tuple[FinishedModel, Poses] | None:
    if not (folder / "sparse" / "0").is_dir():
        return None
    model = read_model(folder / "sparse" / "0")
    cameras = {model.image(i).name: model.camera(model.image(i).camera_id) for i in model.images}
    sizes = {name: ((c.width, c.height), (1.0, 1.0)) for name, c in cameras.items()}
    arrays = Model.from_colmap(model, sizes)
    shown = FinishedModel(arrays.views, arrays.tracks, point_colours(model), arrays.errors_px())
    return shown, model_poses(model)


def _with_reference(
    report: RunReport, poses: Poses, given: Path | None
) -> tuple[RunReport, ReferencePoses | None]:
    """The reference poses, and the report with the errors against them.

    Args:
      given: reference poses that the user named. They must be readable. Those that the run was
        given may be gone, which is only a warning.
    """
    recorded = report.options.reference
    path = given or (None if recorded is None else Path(recorded))
    if path is None:
        return report, None
    try:
        reference = read_poses(path)
        _, _, similarity = common_alignment(poses, reference)
        evaluation = evaluation_report(poses, reference)
    except UserError as error:
        if given is not None:
            raise
        logger.warning("the reference poses of the run are not shown: %s", error)
        return report, None
    report = dataclasses.replace(report, evaluation=evaluation)
    return report, ReferencePoses(reference, similarity)


def evaluation_report(poses: Poses, reference: Poses) -> EvaluationReport:
    """The errors of a model's poses against reference poses.

    Raises:
      UserError: the two have too few photos in common.
    """
    return from_json(EvaluationReport, evaluate(poses, reference).as_dict())


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
    found = _model(folder) if report.models else None
    model, poses = found if found else (None, {})
    if reference is not None and not poses:
        raise UserError(f"--reference {reference}: {folder} has no model to compare with it")
    report, known = _with_reference(report, poses, reference) if poses else (report, None)
    return FinishedRun(
        folder=folder,
        report=report,
        photos=RecordedPhotos(where, report.identity.images, report.options.config),
        model=model,
        reference=known,
        matches=Store(home, report.identity.to_json()),
    )
