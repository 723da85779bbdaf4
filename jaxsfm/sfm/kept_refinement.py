"""Parts of the refinement of a run that are kept until all of it is done: passes, and finished
models."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_folders import read_models, write_models
from jaxsfm.colmap.model_images import fingerprint
from jaxsfm.io.kept_folders import Steps
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.one_pass import PassFigures, PassOutcome, PassSettings, Refined, run_pass
from jaxsfm.sfm.refine.passes import RefinementFigures, figures_from_json
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits

if TYPE_CHECKING:
    import pycolmap

MODELS, FIGURES = "models", "figures.json"
RefinedModel = tuple["pycolmap.Reconstruction", RefinementFigures | None]
"""A model after the refinement, and what was done to it; None where it was not refined."""


class KeptRefinement(NamedTuple):
    """Where the parts of the refinement of one model are kept."""

    steps: Steps
    name: str
    """Tells the model from the others of the run."""
    database: Path
    """Of the cameras of the model."""

    def run_pass(
        self,
        before: Refined,
        images: DeviceImages,
        px: int,
        limits: AlignmentLimits,
        settings: PassSettings,
    ) -> PassOutcome:
        """`jaxsfm.sfm.refine.one_pass.run_pass`, which may have been done before."""

        def compute(folder: Path) -> None:
            after, done = run_pass(before, images, px, limits, settings)
            self._write(folder, after.reconstruction, dataclasses.asdict(done))

        about = [fingerprint(before.reconstruction), px, limits._asdict()]
        model, row = self._kept("pass", compute, about)
        assert row is not None
        return Refined(model, Model.from_colmap(model, before.model.sizes)), PassFigures(**row)

    def finished(
        self, model: "pycolmap.Reconstruction", refine: Callable[[], RefinedModel]
    ) -> RefinedModel:
        """What `refine` gives for a model, which may have been done before."""

        def compute(folder: Path) -> None:
            after, done = refine()
            self._write(folder, after, done and dataclasses.asdict(done))

        after, row = self._kept("refined", compute, [fingerprint(model)])
        return after, None if row is None else figures_from_json(row)

    def _write(
        self, folder: Path, model: "pycolmap.Reconstruction", figures: dict[str, Any] | None
    ) -> None:
        write_models([model], folder / MODELS)
        (folder / FIGURES).write_text(json.dumps(figures), encoding="utf-8")

    def _kept(
        self, part: str, compute: Callable[[Path], None], about: list[Any]
    ) -> "tuple[pycolmap.Reconstruction, dict[str, Any] | None]":
        folder = self.steps.kept(f"{self.name}-{part}", about, compute)
        (model,) = read_models(folder / MODELS, self.database)
        return model, json.loads((folder / FIGURES).read_text(encoding="utf-8"))
