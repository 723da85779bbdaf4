"""The refinement of all models of a run, and of the places that it gives to further photos."""

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.cameras import pixels_were_turned
from jaxsfm.colmap.database import read_images
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_folders import colour_points
from jaxsfm.colmap.model_images import registered
from jaxsfm.colmap.other_camera import other_camera
from jaxsfm.colmap.triangulation import with_all_points
from jaxsfm.colmap.turned_camera import adjust_as_one, shares_one_camera
from jaxsfm.config import WORTH, Config, Refinement
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
from jaxsfm.sfm.refine.passes import PassRun, RefinementFigures, refine_model, with_progress

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")


class Believed(NamedTuple):
    """What says where photos stand that the mapper left out."""

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
    """For each model, its index among the models of the mapper."""


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
    cameras = read_images(believed.database)
    mapped = {name for model in models for name in registered(model)}
    unmapped = [UnmappedImage(name, *cameras[name]) for name in sorted({*cameras} - mapped)]
    evidence = Evidence(believed.matches, unmapped, options.seed)
    refining = _Refining(photos, believed, config, options, neighbours(believed.verified), on_pass)
    refined, figures = [], []
    for number, model in enumerate(models):
        if config.refinement is None:
            new, done = model, None
        elif steps is None:
            new, done = refining.refined(model, evidence)
        else:
            kept = KeptRefinement(steps, f"model-{number}", believed.database)
            refine = functools.partial(refining.refined, model, evidence, kept.run_pass)
            new, done = kept.finished(model, refine, [each.name for each in evidence.unmapped])
        left = [image for image in evidence.unmapped if image.name not in registered(new)]
        evidence = evidence._replace(unmapped=left)
        refined.append(new)
        figures.append(done)
    # Refinement adds and removes images: the first model is again the one with most.
    order = sorted(range(len(refined)), key=lambda k: -refined[k].num_reg_images())
    for model in refined:
        colour_points(model, photos.rgb)
    return RefinedModels([refined[k] for k in order], [figures[k] for k in order], order)


class _Refining(NamedTuple):
    """What all models of a run are refined with."""

    photos: Photos
    believed: Believed
    config: Config
    options: MapOptions
    following: Collection[Pair]
    """Verified pairs of photos that follow each other."""
    on_pass: Callable[[], None]

    def refined(
        self,
        model: "pycolmap.Reconstruction",
        evidence: Evidence,
        run: PassRun = run_pass,
    ) -> RefinedModel:
        """A model after the refinement; if a photo cannot be read, it is not refined."""
        refinement, options = self.config.refinement, self.options
        assert refinement is not None
        try:
            new, done = refine_model(
                model,
                self.photos.gray,
                PassSettings(refinement, options.refine_intrinsics, options.threads),
                evidence=evidence,
                with_all_points=self._whole,
                described_px=described_px(options.scale / self.photos.median_scale()),
                run=with_progress(self.on_pass, run),
            )
            if self.config.checked:
                matches = self.believed.matches
                new, done = _without_doubtful(
                    new, done, self.photos, matches, self.following, refinement
                )
        except ImageError as error:  # a photo was deleted since; the mapper's model remains
            logger.warning("no refinement: %s", error)
            return self._whole(model), None
        if options.refine_intrinsics:
            new = _with_one_camera(new, self.photos, options.threads)
        else:
            camera = other_camera(new, threads=options.threads)
            done = dataclasses.replace(done, camera=camera)
        return new, done

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


def _without_doubtful(
    model: "pycolmap.Reconstruction",
    done: RefinementFigures,
    photos: Photos,
    matches: Mapping[Pair, PairResult],
    following: Collection[Pair],
    refinement: Refinement,
) -> "tuple[pycolmap.Reconstruction, RefinementFigures]":
    """A refined model without the new photos whose places are doubtful, and what was done to it."""
    placed = [at for at in done.placed if at.octave_px and not (at.registered or at.doubt)]
    new = {at.name: at.rests_on_details() for at in placed}
    if not new:
        return model, done
    whole, images = opened(model, photos)
    found = doubts(whole, images, refinement, Placed(new, following, matches))
    if not found:
        return model, done
    left = whole.part(set(registered(model)) - found.keys())[0]
    every = [dataclasses.replace(at, doubt=found.get(at.name, at.doubt)) for at in done.placed]
    return left.to_colmap(), dataclasses.replace(done, placed=every)
