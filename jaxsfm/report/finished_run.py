"""A finished run, read again from what its folder keeps: for looking at it, never for going on."""

import dataclasses
import functools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model as ModelArrays
from jaxsfm.colmap.model import point_colours
from jaxsfm.colmap.poses import Poses, model_poses, read_model, read_poses
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Config, PairShape, Refinement
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile, WorkingImage, inspect_image, read_image
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.store import Store
from jaxsfm.io.work_folder import RECORD
from jaxsfm.report.schema import read_report
from jaxsfm.sfm.evaluation import Similarity, common_alignment, evaluate

logger = logging.getLogger(__name__)


class Model(NamedTuple):
    """The best model, in original pixels (`View.pixels` are theirs)."""

    views: Sequence[View]
    tracks: Tracks
    colours: np.ndarray
    """uint8 (n, 3), RGB of the points."""
    errors: np.ndarray
    """float64 (m,): reprojection error of every observation, original pixels."""


class Reference(NamedTuple):
    """Reference poses and how the model is moved onto them."""

    poses: Poses
    similarity: Similarity
    """Model to reference."""


class Photos:
    """The run's photos, as long as they are where they were and what they were."""

    def __init__(self, folder: Path | None, hashes: Mapping[str, str], report: Mapping) -> None:
        config = report["options"]["config"]
        self.folder = folder
        self._hashes = hashes
        self._sizes = {"max_size": config["max_size"], "enlarge": config["enlarge"]}
        self.read = functools.lru_cache(maxsize=16)(self._read)

    def file(self, name: str) -> ImageFile | None:
        """A photo's file; None if it is gone or changed."""
        if self.folder is None:
            return None
        try:
            image = inspect_image(self.folder / name, name=name)
        except ImageError:
            return None
        return image if image.sha256 == self._hashes.get(name) else None

    def recorded(self, name: str) -> ImageFile:
        """A photo as the run found it; nobody looks whether it is still there. Its size is not
        known."""
        path = (self.folder or Path()) / name
        return ImageFile(name=name, path=path, size=(0, 0), sha256=self._hashes[name])

    def called(self, sha256: str) -> str | None:
        """What the run calls a photo of that content."""
        return next((name for name, each in self._hashes.items() if each == sha256), None)

    def _read(self, name: str) -> WorkingImage | None:
        """A photo at working size; None if it is gone, changed or cannot be decoded."""
        image = self.file(name)
        try:
            return image and read_image(image, **self._sizes)
        except ImageError:
            return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class KeptRun:
    """What is left of a run."""

    folder: Path
    """Where its results lie."""
    report: dict[str, Any]
    """The content of report.json; `evaluation` is against `reference`."""
    photos: Photos
    model: Model | None
    reference: Reference | None
    matches: Store

    @property
    def config(self) -> Config:
        """The run's.

        Raises:
          UserError: this version of jaxsfm does not know it.
        """
        plain = dict(self.report["options"]["config"])
        try:
            shape, refinement = PairShape(**plain.pop("pair")), plain.pop("refinement")
            passes = refinement and Refinement(**refinement)
            return Config(**plain, pair=shape, refinement=passes)
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{self.folder}: was made by jaxsfm {self.report.get('version')}, whose options "
                "this version does not know; run reconstruct again"
            ) from error

    def load_matches(self, pair: Pair) -> PairResult | None:
        """Of one pair, original pixels; None if there are none or the file is gone."""
        return self.matches.load_matches(pair)


def _model(folder: Path) -> tuple[Model, Poses] | None:
    if not (folder / "sparse" / "0").is_dir():
        return None
    model = read_model(folder / "sparse" / "0")
    cameras = {model.image(i).name: model.camera(model.image(i).camera_id) for i in model.images}
    sizes = {name: ((c.width, c.height), (1.0, 1.0)) for name, c in cameras.items()}
    arrays = ModelArrays.from_colmap(model, sizes)
    shown = Model(arrays.views, arrays.tracks, point_colours(model), arrays.errors_px())
    return shown, model_poses(model)


def _reference(report: dict[str, Any], poses: Poses, given: Path | None) -> Reference | None:
    """Reference poses, and in `report` the errors against them.

    Those that the run was given may be gone by now; those that are given now must be readable.
    """
    recorded = report["options"].get("reference")
    if given is None and recorded is None:
        return None
    try:
        reference = read_poses(given or Path(recorded))
        _, _, similarity = common_alignment(poses, reference)
        report["evaluation"] = evaluate(poses, reference).as_dict()
    except UserError as error:
        if given is not None:
            raise
        logger.warning("the reference poses of the run are not shown: %s", error)
        return None
    return Reference(reference, similarity)


def read_run(folder: Path, *, images: Path | None = None, reference: Path | None = None) -> KeptRun:
    """Read a run's results.

    Args:
      folder: a run's OUT, or OUT/failed.
      images: folder of the photos; default: where the run found them.
      reference: reference poses to compare with; default: the run's.

    Raises:
      UserError: no finished run, or what was named cannot be used.
    """
    report = read_report(folder)
    if images is not None and not images.is_dir():
        raise UserError(f"--images {images}: no such folder")
    home = folder if (folder / RECORD).exists() else folder.parent
    recorded = report["images"].get("folder")
    where = images or (Path(recorded) if recorded else None)
    found = _model(folder) if report["models"] else None
    model, poses = found if found else (None, {})
    if reference is not None and not poses:
        raise UserError(f"--reference {reference}: {folder} has no model to compare with it")
    return KeptRun(
        folder=folder,
        report=report,
        photos=Photos(where, report["identity"]["images"], report),
        model=model,
        reference=_reference(report, poses, reference) if poses else None,
        matches=Store(home, report["identity"]),
    )
