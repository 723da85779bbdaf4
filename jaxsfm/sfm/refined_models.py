"""The refinement of all models of a run, of which the parts stay that confirmed points hold."""

import dataclasses
import logging
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxsfm.colmap.cameras import pixels_were_turned
from jaxsfm.colmap.given_model import has_rigs
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import with_all_points
from jaxsfm.colmap.other_camera import other_camera
from jaxsfm.colmap.reconstruction import colour_points, registered
from jaxsfm.colmap.rigs import whole_frames
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.turned_cameras import adjust_as_one, shares_one_camera
from jaxsfm.config import WORTH, Config
from jaxsfm.errors import UserError, remark
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos
from jaxsfm.sfm.check.model_check import MIN_VIEWS
from jaxsfm.sfm.checker import opened
from jaxsfm.sfm.refine.fixed_structure import ResectionMatches
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT
from jaxsfm.sfm.refine.one_pass import PassSettings
from jaxsfm.sfm.refine.passes import (
    RefinementFigures,
    refine_model,
)
from jaxsfm.sfm.refine.weak_views import taken_out
from jaxsfm.sfm.selected_stage import adjusted_component

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

RefinedModel = tuple["pycolmap.Reconstruction", RefinementFigures | None]
"""A model after the refinement, and what was done to it; None where it was not refined."""


class Believed(NamedTuple):
    """What says where photos stand that show too little."""

    database: Path
    """Its verified matches become points."""
    matches: Mapping[Pair, PairResult]
    """The matches that no check has found to be false, original pixels."""


class RefinedModels(NamedTuple):
    """The outcome of the refinement."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first."""
    figures: list[RefinementFigures | None]
    """For each model, what was done to it; None where it was not refined."""
    order: list[int]
    """For each model, the index of the given model that it was, or was a part of."""


def refine_models(
    models: "list[pycolmap.Reconstruction]",
    photos: Photos,
    believed: Believed,
    *,
    config: Config,
    options: MapOptions,
    on_pass: Callable[[], None] = lambda: None,
) -> RefinedModels:
    """Refine the models, if asked for, and colour their points.

    Models that are refined have the points of a share of the matches; they get those of all.

    Args:
      photos: at the size that the refinement works at.
      config: its `refinement` and `checked` switch these parts on.
      options: of the mapper; its `scale` is that of the photos in which keypoints were found.
    """
    refining = _Refining(photos, believed, config, options, on_pass)
    made = [
        (number, *part)
        for number, model in enumerate(models)
        for part in refining.held(*refining.refined(model))
    ]
    # Images may have been taken out: the first model is again the one with most.
    made.sort(key=lambda each: -each[1].num_reg_images())
    for _, model, _ in made:
        colour_points(model, photos.rgb)
    return RefinedModels(
        [model for _, model, _ in made], [done for _, _, done in made], [k for k, _, _ in made]
    )


class _Refining(NamedTuple):
    """What all models of a run are refined with."""

    photos: Photos
    believed: Believed
    config: Config
    options: MapOptions
    on_pass: Callable[[], None] = lambda: None

    def refined(self, model: "pycolmap.Reconstruction") -> RefinedModel:
        """A model after the refinement. It stays as it is if no refinement is asked for, and if a
        photo cannot be read."""
        options = self.options
        if self.config.refinement is None:
            return model, None
        try:
            new, done = refine_model(
                model,
                self.photos.gray,
                self._settings(),
                resection=ResectionMatches(self.believed.matches, options.seed),
                with_all_points=self._whole,
                described_px=described_px(options.scale / self.photos.median_scale()),
                on_pass=self.on_pass,
            )
        except ImageError as error:  # a photo was deleted since; the mapper's model remains
            logger.warning("no refinement: %s", error)
            return self._whole(model), None
        if options.refine_intrinsics:
            new = _with_one_camera(new, self.photos, options.threads)
        else:
            camera = remark(
                "whether the photos speak for another camera",
                lambda: other_camera(new, threads=options.threads),
            )
            done = dataclasses.replace(done, camera=camera)
        return new, done

    def held(
        self, model: "pycolmap.Reconstruction", done: RefinementFigures | None
    ) -> list[RefinedModel]:
        """The parts of a refined model that hold together, each adjusted by itself.

        Photos of parts of less than `MIN_VIEWS` have no place any more; registration looks for
        another one. A model of which nothing would be left stays as it is, and does not count as
        confirmed.
        """
        if done is None or model.num_reg_images() < MIN_VIEWS:
            return [(model, done)]
        arrays = opened(model, self.photos)[0]
        names = [view.name for view in arrays.views]
        asked = self._settings().refinement.weak_octaves > 0
        unconfirmed = done.unconfirmed_views() if asked else set()
        use = np.asarray([name not in unconfirmed for name in names])[arrays.tracks.view]
        held = covisibility_components(arrays.tracks.select(use), len(names))
        parts = whole_frames(([names[k] for k in part] for part in held), model)
        left = [part for part in parts if len(part) >= MIN_VIEWS]
        if len(parts) == 1 or not left:
            return [(model, dataclasses.replace(done, holds=bool(left)))]
        stay = {name for part in left for name in part}
        shown = np.bincount(arrays.tracks.view, minlength=len(names)).tolist()
        rows = {row.name: row for row in done.registrations}
        out = [
            dataclasses.replace(rows[name], held=count)
            if name in unconfirmed
            else taken_out(name, count)
            for name, count in zip(names, shown, strict=True)
            if name not in stay
        ]
        made: list[RefinedModel] = []
        for part in left:
            scale = self.photos.median_scale()
            alone = adjusted_component(model, part, loss_px=scale, options=self.options)
            own = [row for row in done.registrations if row.name in part]
            # What became of photos that no model has stands in the first part.
            own += (
                [] if made else [row for row in done.registrations if row.name not in names] + out
            )
            made.append((alone, dataclasses.replace(done, registrations=own)))
        return made

    def _settings(self) -> PassSettings:
        assert self.config.refinement is not None
        options = self.options
        return PassSettings(
            self.config.refinement, options.refine_intrinsics, options.threads, options.held
        )

    def _whole(self, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        return with_all_points(model, self.believed.database, self.options)


def covisibility_components(tracks: Tracks, count: int) -> list[list[int]]:
    """Parts of a refined model that confirmed points hold together.

    The refinement keeps only the observations that alignment confirms. What is left of a wrong
    model are points of two views each, here and there: any two photos have such points, wherever
    the others are. Where a third view stands, and how large a part is beside another, is told by
    points that three views show.

    Two views are in one part if they share `MIN_COUNT` points that a third view shows, or if a
    chain of such views joins them. So much holds a view that is placed, and COLMAP's mapper asks
    for the same number to register an image. In right models of 17 sets of photos all views are
    one part, with 50 points as well, but for one view of *temple_sparse_ring*. A wrong model of
    that set falls into ten views and six single ones (docs/decisions/one-road.md).

    Args:
      count: the number of views.

    Returns:
      indices of the views of each part, the largest part first; the first view of equal ones.
    """
    use = tracks.num_observations()[tracks.point] >= 3
    at = (tracks.view[use], tracks.point[use])
    shape = (count, len(tracks.points))
    seen = coo_array((np.ones(len(at[0]), np.int32), at), shape=shape).tocsr()
    shared = (seen @ seen.T).tocsr()
    shared.data[shared.data < MIN_COUNT] = 0
    shared.eliminate_zeros()
    _, label = connected_components(shared, directed=False)
    parts = [np.flatnonzero(label == each).tolist() for each in range(label.max(initial=-1) + 1)]
    return sorted(parts, key=lambda part: (-len(part), part))


def _with_one_camera(
    model: "pycolmap.Reconstruction", photos: Photos, threads: int
) -> "pycolmap.Reconstruction":
    """A model whose photos of one camera were turned differently, adjusted for that camera."""
    files = {name: photos.files[name] for name in registered(model)}
    codes = {name: file.orientation for name, file in files.items()}
    turned = pixels_were_turned(list(files.values()))
    if has_rigs(model) or not (turned and shares_one_camera(model, codes)):
        return model
    try:
        return adjust_as_one(model, codes, threads=threads)
    except UserError:  # cameras of this kind cannot be turned
        return model


def described_px(ratio: float) -> int:
    """The size in which keypoints were found, as the nearest power of two of working pixels.

    After low-resolution matching it is at least two, so that a pass at full size follows the
    others. With two passes at full size instead, the demo (described at 480 px of 640) is 0.0145
    instead of 0.0062 deg off.

    Args:
      ratio: working pixels per pixel of the images in which they were found, at least 1.
    """
    return 2 ** max(int(ratio >= WORTH), round(math.log2(ratio)))
