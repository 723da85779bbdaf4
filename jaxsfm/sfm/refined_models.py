"""The refinement of all models of a run, and of the places that it gives to further photos."""

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.cameras import pixels_were_turned
from jaxsfm.colmap.database import read_images
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_folders import colour_points
from jaxsfm.colmap.model_images import registered, registered_in_any
from jaxsfm.colmap.other_camera import other_camera
from jaxsfm.colmap.triangulation import with_all_points
from jaxsfm.colmap.turned_camera import adjust_as_one, shares_one_camera
from jaxsfm.config import WORTH, Config
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError
from jaxsfm.io.kept_folders import Steps
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.sfm.check.placed_views import Placed, doubts
from jaxsfm.sfm.checker import opened
from jaxsfm.sfm.kept_refinement import KeptRefinement, RefinedModel
from jaxsfm.sfm.photo_order import neighbours
from jaxsfm.sfm.refine.evidence import Evidence, UnmappedImage
from jaxsfm.sfm.refine.one_pass import PassSettings, run_pass
from jaxsfm.sfm.refine.passes import (
    PassRun,
    RefinementFigures,
    place_images,
    refine_model,
    with_progress,
)

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")


class Believed(NamedTuple):
    """What says where photos stand that are in no model, or that show too little."""

    database: Path
    """Of all photos, with those that are in no model. Its verified matches become points."""
    matches: Mapping[Pair, PairResult]
    """The matches that no check has found to be false, original pixels."""
    verified: Collection[Pair]
    """Those of these pairs that COLMAP verified."""


class RefinedModels(NamedTuple):
    """The outcome of the refinement."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first."""
    figures: list[RefinementFigures | None]
    """For each model, what was done to it; None where it was not refined."""
    order: list[int]
    """For each model, its index among the given models."""


def refine_models(
    models: "list[pycolmap.Reconstruction]",
    photos: Photos,
    believed: Believed,
    *,
    config: Config,
    options: MapOptions,
    on_pass: Callable[[], None] = lambda: None,
    steps: Steps | None = None,
) -> RefinedModels:
    """Refine the models, if asked for, and colour their points.

    Models that are refined have the points of a share of the matches; they get those of all.

    They are refined one after the other, each with the unmapped photos that none before took.

    Args:
      photos: at the size that the refinement works at.
      config: its `refinement` and `checked` switch these parts on.
      options: of the mapper; its `scale` is that of the photos in which keypoints were found.
      steps: where passes and models are kept until all are refined; None: nowhere.
    """
    refining = _Refining(photos, believed, config, options, neighbours(believed.verified), on_pass)

    def refine(number: int, evidence: Evidence) -> RefinedModel:
        model = models[number]
        if config.refinement is None:
            return model, None
        if steps is None:
            return refining.refined(model, evidence)
        kept = KeptRefinement(steps, f"model-{number}", believed.database)
        refined = functools.partial(refining.refined, model, evidence, kept.run_pass)
        return kept.finished(model, refined, [each.name for each in evidence.unmapped])

    unmapped = read_images(believed.database).keys() - registered_in_any(models)
    made = _one_by_one(len(models), refining.evidence(unmapped), refine)
    for model in made.models:
        colour_points(model, photos.rgb)
    return made


def place_photos(
    models: "list[pycolmap.Reconstruction]",
    figures: Sequence[RefinementFigures | None],
    photos: Photos,
    believed: Believed,
    *,
    lost: Collection[str],
    config: Config,
    options: MapOptions,
) -> RefinedModels:
    """Place lost photos on refined models, one model after the other, as the refinement does.

    Args:
      figures: for each model, what the refinement did; None: it was not refined, and gets no photo.
      photos, config, options: those of the refinement.
      lost: names of photos that are in no model.

    Returns:
      the models, which are the same where no photo was placed. Their figures have the photos that
      were.
    """
    refining = _Refining(photos, believed, config, options, neighbours(believed.verified))

    def place(number: int, evidence: Evidence) -> RefinedModel:
        return refining.placed(models[number], figures[number], evidence)

    made = _one_by_one(len(models), refining.evidence(lost), place)
    for model, k in zip(made.models, made.order, strict=True):
        if model is not models[k]:
            colour_points(model, photos.rgb)
    return made


def _one_by_one(
    count: int, evidence: Evidence, refine: Callable[[int, Evidence], RefinedModel]
) -> RefinedModels:
    """Refine each of `count` models, with the unmapped photos that none before has taken."""
    made = []
    for number in range(count):
        made.append(refine(number, evidence))
        taken = registered(made[-1][0])
        left = [image for image in evidence.unmapped if image.name not in taken]
        evidence = evidence._replace(unmapped=left)
    # Images were added and removed: the first model is again the one with most.
    order = sorted(range(count), key=lambda k: -made[k][0].num_reg_images())
    return RefinedModels([made[k][0] for k in order], [made[k][1] for k in order], order)


class _Refining(NamedTuple):
    """What all models of a run are refined with."""

    photos: Photos
    believed: Believed
    config: Config
    options: MapOptions
    following: Collection[Pair]
    """Verified pairs of photos that follow each other."""
    on_pass: Callable[[], None] = lambda: None

    def evidence(self, unmapped: Collection[str]) -> Evidence:
        """The matches that place photos, and the photos that are in no model, by name."""
        cameras = read_images(self.believed.database)
        images = [UnmappedImage(name, *cameras[name]) for name in sorted(unmapped)]
        return Evidence(self.believed.matches, images, self.options.seed)

    def refined(
        self,
        model: "pycolmap.Reconstruction",
        evidence: Evidence,
        run: PassRun = run_pass,
    ) -> RefinedModel:
        """A model after the refinement; if a photo cannot be read, it is not refined."""
        options = self.options
        try:
            new, done = refine_model(
                model,
                self.photos.gray,
                self._settings(),
                evidence=evidence,
                with_all_points=self._whole,
                described_px=described_px(options.scale / self.photos.median_scale()),
                run=with_progress(self.on_pass, run),
            )
            new, done = self._without_doubtful(new, done)
        except ImageError as error:  # a photo was deleted since; the mapper's model remains
            logger.warning("no refinement: %s", error)
            return self._whole(model), None
        if options.refine_intrinsics:
            new = _with_one_camera(new, self.photos, options.threads)
        else:
            camera = other_camera(new, threads=options.threads)
            done = dataclasses.replace(done, camera=camera)
        return new, done

    def placed(
        self,
        model: "pycolmap.Reconstruction",
        done: RefinementFigures | None,
        evidence: Evidence,
    ) -> RefinedModel:
        """A refined model with the unmapped photos that have a place in it."""
        if done is None or not evidence.unmapped:
            return model, done
        try:
            new, placed = place_images(model, self.photos.gray, self._settings(), evidence=evidence)
            found = dataclasses.replace(done, placed=placed)
            new, found = self._without_doubtful(new, found)
        except ImageError as error:  # a photo was deleted since
            logger.warning("no further photo is placed: %s", error)
            return model, done
        mine = {at.name: at for at in found.placed if at.name in registered(new)}
        if not mine:
            return model, done
        # A photo without a place keeps the reason for which it was taken out.
        every = {at.name: at for at in done.placed} | mine
        return new, dataclasses.replace(done, placed=[*every.values()])

    def _settings(self) -> PassSettings:
        assert self.config.refinement is not None
        options = self.options
        return PassSettings(self.config.refinement, options.refine_intrinsics, options.threads)

    def _without_doubtful(
        self, model: "pycolmap.Reconstruction", done: RefinementFigures
    ) -> "tuple[pycolmap.Reconstruction, RefinementFigures]":
        """A refined model without the new photos whose places are doubtful, and what was done."""
        placed = [at for at in done.placed if at.octave_px and not (at.registered or at.doubt)]
        new = {at.name: at.rests_on_details() for at in placed}
        if not (self.config.checked and new):
            return model, done
        whole, images = opened(model, self.photos)
        tests = Placed(new, self.following, self.believed.matches)
        found = doubts(whole, images, self._settings().refinement, tests)
        if not found:
            return model, done
        left = whole.part(set(registered(model)) - found.keys())[0]
        every = [dataclasses.replace(at, doubt=found.get(at.name, at.doubt)) for at in done.placed]
        return left.to_colmap(), dataclasses.replace(done, placed=every)

    def _whole(self, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        return with_all_points(model, self.believed.database, self.options)


def _with_one_camera(
    model: "pycolmap.Reconstruction", photos: Photos, threads: int
) -> "pycolmap.Reconstruction":
    """A model whose photos of one camera were turned differently, adjusted for that camera."""
    files = {name: photos.files[name] for name in registered(model)}
    codes = {name: file.orientation for name, file in files.items()}
    if not (pixels_were_turned(list(files.values())) and shares_one_camera(model, codes)):
        return model
    try:
        return adjust_as_one(model, codes, threads=threads)
    except UserError:  # cameras of this kind cannot be turned
        return model


def described_px(ratio: float) -> int:
    """The size in which keypoints were found, as the nearest power of two of working pixels.

    After a first look it is at least two, so that a pass at full size follows the others. With two
    passes at full size instead, the demo (described at 480 px of 640) is 0.0145 instead of 0.0062
    deg off.

    Args:
      ratio: working pixels per pixel of the images in which they were found, at least 1.
    """
    return 2 ** max(int(ratio >= WORTH), round(math.log2(ratio)))
