"""Checks of the models of a run, on its photos at working size."""

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.reconstruction import registered
from jaxsfm.colmap.rigs import whole_frames
from jaxsfm.colmap.two_views import TwoView
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.sfm.check.check_model import Checked, VerifiedMatches, check_model
from jaxsfm.sfm.check.model_check import MIN_VIEWS, ModelCheck, repeats
from jaxsfm.sfm.check.pose_ambiguity import find_pose_ambiguities
from jaxsfm.sfm.refine.device_images import DeviceImages

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

CheckedModel = tuple["pycolmap.Reconstruction", Checked | None]
"""A model and its check; None where it was not checked."""


class VerifiedPairs(NamedTuple):
    """What the mapper starts from."""

    database: Path
    """With all verified pairs."""
    two_views: Mapping[Pair, TwoView]
    """Their geometries."""
    matches: Mapping[Pair, PairResult]
    """Their matches, original pixels."""
    photos: Photos


def opened(model: "pycolmap.Reconstruction", photos: Photos) -> tuple[Model, DeviceImages]:
    """A model in working pixels, and its photos."""
    sizes = {name: photos.working_size(name) for name in registered(model)}
    return Model.from_colmap(model, sizes), DeviceImages(photos.gray)


class Checker(NamedTuple):
    """Checks models that were made from verified pairs."""

    given: VerifiedPairs
    config: Config
    """Its `checked` switches all checks on, and its `refinement` says how patches are aligned."""
    seed: int
    """For RANSAC."""
    with_all_points: "Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction]"
    """Gives a model the points of all matches. The mapper's own points are few, and do not show
    small differences."""

    def check(self, models: "Sequence[pycolmap.Reconstruction]") -> list[Checked | None]:
        """The checks of models; None where one was not checked."""
        if not self.config.checked:
            return [None] * len(models)
        matches = self._matches()
        checks = []
        for each in models:
            if each.num_reg_images() < MIN_VIEWS:
                checks.append(None)
                continue
            try:
                done = check_model(*self._opened(each), matches, self._refinement())
                if done is not None:
                    done = done._replace(components=whole_frames(done.components, each))
                checks.append(done)
            except ImageError as error:  # a photo was deleted since; the model remains
                logger.warning("a model was not checked: %s", error)
                checks.append(None)
        return checks

    def with_pose_ambiguities(
        self, model: "pycolmap.Reconstruction", done: Checked, check: ModelCheck
    ) -> ModelCheck:
        """A check with the second places of the photos.

        They are not looked for if photos contradict each other, here or in other models: this
        speaks against the model already.
        """
        if check.contradictions or repeats(check.split_groups):
            return check
        try:
            found = find_pose_ambiguities(
                *self._opened(model),
                self._matches(),
                self._refinement(),
                done.against,
            )
        except ImageError as error:
            logger.warning("pose ambiguities were not looked for: %s", error)
            return check
        return dataclasses.replace(check, pose_ambiguities=found)

    def _opened(self, model: "pycolmap.Reconstruction") -> tuple[Model, DeviceImages]:
        return opened(self.with_all_points(model), self.given.photos)

    def _matches(self) -> VerifiedMatches:
        given = self.given
        return VerifiedMatches(given.matches, given.two_views.keys(), self.seed)

    def _refinement(self) -> Refinement:
        return self.config.refinement or Refinement()
