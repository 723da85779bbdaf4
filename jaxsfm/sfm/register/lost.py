"""Registration of the photos of a run that have no place after the refinement.

These are photos that the mapper has lost, that were split off, or that the refinement has taken
out. They are located as photos that are added later (`jaxsfm.sfm.register.grow`), in the best of
all refined models, and their places have to stand the same tests. The matches that the run has are
tried first, then those with the best partners at full size, and last those as seen from one place.

A photo is located by points that stay where they are. Errors add up from photo to photo if many
follow each other in this way, so a model that has got photos is adjusted as a whole, unless one of
its photos is too dark or too different for its full size.
"""

import dataclasses
import functools
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from jaxsfm.colmap.bundle_adjustment import adjusted
from jaxsfm.colmap.database import read_images
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.model_files import read_models
from jaxsfm.colmap.reconstruction import colour_points, fingerprint, registered_in_any
from jaxsfm.colmap.rigid_model import with_frame_mates
from jaxsfm.colmap.rigs import Rigs, rigs_of_database
from jaxsfm.colmap.view import View
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos, Pixels
from jaxsfm.io.store import digest
from jaxsfm.io.typed_files import read_figures
from jaxsfm.sfm.checker import opened
from jaxsfm.sfm.limits import REGISTER
from jaxsfm.sfm.mapped_stage import FIGURES, SPARSE, MatchedPhotos, StageCache
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import ResectionMatches
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt
from jaxsfm.sfm.refined_models import RefinedModels
from jaxsfm.sfm.refined_stage import (
    Reconstructed,
    RefinedFigures,
    believed_matches,
    refinement_settings,
    write_refined,
)
from jaxsfm.sfm.register.grow import grow
from jaxsfm.sfm.register.locate_view import Localization, UnregisteredView
from jaxsfm.sfm.selected_stage import SelectedModels

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

RIGID_PX = 4.0
"""Observations in photos that a rig has moved may be so far off, working pixels: as far as those of
COLMAP's mapper."""


class MatchLost(Protocol):
    """Matches photos without a place with their best partners, at full size."""

    def __call__(
        self,
        lost: Collection[str],
        registered: Collection[str],
        false: Collection[Pair],
        *,
        further: bool,
    ) -> Mapping[Pair, PairResult]:
        """The matches, original pixels. Pairs that were found to be false are left out.

        Args:
          further: whether a photo is also matched at other scales, turned, and as seen from one
            place, which takes up to a minute for a pair. Then the matches are those of one photo,
            or empty if none is left. Otherwise all photos are matched as they are.
        """
        ...


def register_lost(
    given: MatchedPhotos,
    selected: SelectedModels,
    made: Reconstructed,
    kept: StageCache,
    match_lost: MatchLost | None,
) -> Reconstructed:
    """Register the photos that have no place in the refined models. Other models stay as they are.

    Args:
      made: the refined models.
      match_lost: gives further matches of photos that are still without a place. None: the matches
        of the run have to do.
    """
    names = {image.name for image in given.images}
    if not any(made.refinement) or not names - registered_in_any(made.models):
        return made

    def compute(folder: Path) -> None:
        found = _Registration(given, selected, made)
        found.register(believed_matches(given, selected))
        found.adjust()
        if match_lost is not None:
            false = selected.figures.misleading()
            further = False
            while lost := found.lost():
                matches = match_lost(lost, found.registered(), false, further=further)
                if found.register(matches):
                    further = False  # new partners; matches as they are may do now
                elif further and not matches:
                    break
                elif not further:
                    found.adjust()
                    further = True
            found.adjust()
        write_refined(folder, found.outcome())

    models = [fingerprint(model) for model in made.models]
    settings = [*refinement_settings(given.config), match_lost is not None]
    key = digest(selected.key, *settings, given.config.max_rectified_planes, models)
    try:
        folder = kept.folder.stage("registered", key, compute)
    except ImageError as error:  # a photo of a model is gone; perhaps it is back next time
        logger.warning("no photos were registered: %s", error)
        return made
    refinement, order = read_figures(folder / FIGURES, RefinedFigures)
    checks = [made.mapping.checks[k] for k in order]
    return dataclasses.replace(
        made,
        mapping=dataclasses.replace(made.mapping, checks=checks),
        models=read_models(folder / SPARSE, selected.database),
        refinement=refinement,
    )


class _Registration:
    """Refined models that take up photos. Models that were not refined take up none."""

    def __init__(self, given: MatchedPhotos, selected: SelectedModels, made: Reconstructed) -> None:
        self._given, self._made = given, made
        self._photos = Photos(given.images, given.config)
        self._cameras = read_images(selected.database)
        self._refined = [k for k, done in enumerate(made.refinement) if done is not None]
        all_rigs = rigs_of_database(selected.database)
        self._models: list[Model] = []
        for k in self._refined:
            model = opened(made.models[k], self._photos)[0]
            if all_rigs is not None:  # it has rigs and frames without a pose as well
                own = model.rigs.rigs if model.rigs else {}
                rigs = Rigs({**all_rigs.rigs, **own}, all_rigs.frames)
                cameras = {c.camera_id: c for _, c in self._cameras.values()} | dict(model.cameras)
                model = dataclasses.replace(model, rigs=rigs, cameras=cameras)
            self._models.append(model)
        self._images = DeviceImages(self._photos.gray)
        self._outcomes: dict[str, Localization] = {}
        self._registered: dict[str, int] = {}
        self._unreadable: set[str] = set()
        self._grown: set[int] = set()

    def registered(self) -> set[str]:
        """The photos with a place."""
        return registered_in_any(self._made.models) | self._registered.keys()

    def lost(self) -> set[str]:
        """The photos without a place that can be read."""
        names = {image.name for image in self._given.images}
        return names - self.registered() - self._unreadable

    def register(self, matches: Mapping[Pair, PairResult]) -> bool:
        """Register lost photos by these matches, original pixels; says whether any was."""
        placed = self.registered()
        wanted = {
            name: view
            for name in sorted(self.lost())
            if (view := self._unregistered(name, placed, matches)) is not None
        }
        own = {name for each in wanted.values() for name in each.shortlist} | wanted.keys()
        pairs = [p for p in matches if wanted.keys() & set(p) and own >= set(p)]
        if not pairs:
            return False
        grown = grow(
            self._models,
            wanted,
            ResectionMatches({pair: matches[pair] for pair in pairs}, self._given.options.seed),
            self._images,
            refinement=self._given.config.refinement,
        )
        self._models = [
            with_frame_mates(model, functools.partial(self._view_of, model))
            for model in grown.models
        ]
        self._outcomes |= grown.located
        self._grown |= {*grown.registered.values()}
        for k, model in zip(self._refined, self._models, strict=True):
            # A photo that is in a frame with one that was registered has a place, too.
            self._registered |= {view.name: k for view in model.views if view.name not in placed}
        return bool(grown.registered)

    def adjust(self) -> None:
        """Adjust the models that have got photos since the last time."""
        for k in sorted(self._grown):
            if not self._coarse(k):
                self._models[k] = self._adjusted(self._models[k])
        self._grown.clear()

    def _coarse(self, k: int) -> bool:
        """Whether a photo of a model has its place by a smaller size. An error of its keypoints is
        a multiple of those of other photos, for which an adjustment does not allow."""
        done = self._made.refinement[self._refined[k]]
        assert done is not None
        own = {name for name, of in self._registered.items() if of == self._refined[k]}
        octaves = [self._outcomes[name].octave_px for name in own & self._outcomes.keys()]
        octaves += [row.octave_px for row in done.registrations if row.registered]
        return any(px is not None and px > 1 for px in octaves)

    def _adjusted(self, model: Model) -> Model:
        """A model with new photos after a bundle adjustment, in which all photos move. Cameras stay
        if photos were turned: one camera may then stand for several, which must agree."""
        options = self._given.options
        turns = {self._photos.files[view.name].orientation for view in model.views}
        found = adjusted(
            model,
            loss_px=float(np.median([view.mean_scale for view in model.views])),
            refine_intrinsics=options.refine_intrinsics and len(turns) == 1,
            threads=options.threads,
            held=options.held,
        )
        if model.rigs is None:
            return found
        # COLMAP's model knows only the frames that have a place; later photos are of others.
        rigs = {**model.rigs.rigs, **(found.rigs.rigs if found.rigs else {})}
        cameras = {**model.cameras, **found.cameras}
        return dataclasses.replace(found, cameras=cameras, rigs=model.rigs._replace(rigs=rigs))

    def _view_of(self, model: Model, image_id: int) -> View:
        """A photo without a pose, with its camera in a model."""
        name, camera = next(
            (n, c) for n, (number, c) in self._cameras.items() if number == image_id
        )
        size, scale = self._photos.working_size(name)
        camera = model.cameras.get(camera.camera_id, camera)
        return View.without_pose(name, image_id, camera, size, Pixels(scale))

    def _unregistered(
        self, name: str, registered: Collection[str], matches: Mapping[Pair, PairResult]
    ) -> UnregisteredView | None:
        """A lost photo with the camera that it has in each model; None if it cannot be used.

        Args:
          registered: the photos with a place.
        """
        partners = {
            other: matches[pair].num_inliers
            for pair in matches
            if name in pair
            for other in set(pair) - {name}
        }
        if not partners:
            return None
        try:
            self._photos.gray(name)
        except ImageError:  # deleted since; it is in no model anyway
            self._unreadable.add(name)
            return None
        size, scale = self._photos.working_size(name)
        image_id, camera = self._cameras[name]
        views, shared = [], False
        for model in self._models:
            if model.rigs and not model.rigs.is_placed(image_id):
                return None
            cameras = {view.camera.camera_id: view.camera for view in model.views}
            shared |= camera.camera_id in cameras
            refined = cameras.get(camera.camera_id, camera)
            views.append(View.without_pose(name, image_id, refined, size, Pixels(scale)))
        ranked = sorted(partners, key=lambda p: (p not in registered, -partners[p], p))
        own_camera = self._given.options.refine_intrinsics and not shared
        return UnregisteredView(views, own_camera, sorted(ranked[: REGISTER.shortlist]))

    def outcome(self) -> RefinedModels:
        """The models with the photos that were registered, the one with most photos first."""
        models: list[pycolmap.Reconstruction] = list(self._made.models)
        for k in sorted({*self._registered.values()}):
            model = self._models[self._refined.index(k)]
            if model.rigs is not None:  # photos of one frame may have been located apart
                model = model.select(model.errors_px() < RIGID_PX)
            models[k] = model.to_colmap()
            colour_points(models[k], self._photos.rgb)
        order = sorted(range(len(models)), key=lambda k: -models[k].num_reg_images())
        figures = [self._figures(k) for k in range(len(models))]
        return RefinedModels([models[k] for k in order], [figures[k] for k in order], order)

    def _figures(self, k: int) -> RefinementFigures | None:
        """What was done to a model, with the photos that were looked for. Photos that have no place
        stand in the first model that was refined."""
        done = self._made.refinement[k]
        if done is None:
            return None
        rows = {row.name: row for row in done.registrations}
        for name, found in self._outcomes.items():
            if self._registered.get(name, self._refined[0]) == k:
                own = _row(name, found)
                # A photo without a place keeps the reason for which it was taken out.
                rows[name] = own if found.trusted else rows.get(name, own)
        return dataclasses.replace(done, registrations=[*rows.values()])


def _row(name: str, found: Localization) -> RegistrationAttempt:
    return RegistrationAttempt(
        name=name,
        registered=False,
        octave_px=found.octave_px,
        candidates=found.candidates,
        agreed=found.agreed,
        error_px=found.error_px,
        reason="" if found.trusted else found.why or "",
    )
