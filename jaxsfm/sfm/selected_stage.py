"""The models that a run goes on with: the better mapping, split where its photos do not agree, and
with the second places of its photos.
"""

import dataclasses
import functools
import shutil
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.bundle_adjustment import UNREFINED_LOSS_PX, bundle_adjust
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import attempt_of
from jaxsfm.colmap.model_files import read_models, write_models
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import fingerprint, part_of
from jaxsfm.errors import remark
from jaxsfm.io.store import digest
from jaxsfm.io.typed_files import read_figures, write_figures
from jaxsfm.options import Step
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.common_places import SAME_SHARE, groups
from jaxsfm.sfm.check.model_check import MIN_VIEWS, Alternative, ModelCheck, repeats
from jaxsfm.sfm.checker import CheckedModel, Checker
from jaxsfm.sfm.mapped_stage import (
    ALTERNATIVE,
    DATABASE,
    FIGURES,
    SPARSE,
    MatchedPhotos,
    StageCache,
    VerifiedStage,
    mapper_of,
    mapping_settings,
    unchecked,
)
from jaxsfm.sfm.mapping import MappedModels, Mapper, MappingFigures

if TYPE_CHECKING:
    import pycolmap


class SelectedModels(NamedTuple):
    """The models that a run goes on with, in the folder of their stage."""

    figures: MappingFigures
    folder: Path
    key: str
    """Identifies all that the models depend on."""

    @property
    def database(self) -> Path:
        """COLMAP's database of the models."""
        return self.folder / DATABASE

    def models(self, name: str = SPARSE) -> "list[pycolmap.Reconstruction]":
        """The models, or the `ALTERNATIVE` ones."""
        return read_models(self.folder / name, self.database)


class _Selected(NamedTuple):
    """Models before they are written."""

    models: "list[pycolmap.Reconstruction]"
    checks: list[ModelCheck | None]
    alternative: "list[pycolmap.Reconstruction]"


def select_models(
    given: MatchedPhotos,
    verified: VerifiedStage,
    made: tuple[MappedModels, MappedModels | None],
    kept: StageCache,
    *,
    without: Collection[Step] = (),
) -> SelectedModels:
    """Keep the better of two mappings, split it where photos do not agree, and look for second
    places of its photos.

    Args:
      made: the first mapping and the second one, if there was one.
      without: steps to skip.

    Raises:
      UserError: COLMAP fails.
    """
    first, second = made
    mapper = mapper_of(given, verified)
    best, other = first, second
    if second is not None and second.better_than(first, mapper.following()):
        best, other = second, first
    attempts = [attempt_of(each.models, given.options.mapper) for each in made if each is not None]

    unread: list[bool] = []

    def compute(folder: Path) -> None:
        shutil.copyfile(best.database, folder / DATABASE)
        found = _selected(given, mapper, best, other, without)
        figures = MappingFigures(
            verdicts=best.trust.verdicts,
            attempts=attempts,
            checks=found.checks,
            basis=best.trust.basis,
        )
        unread.append(given.config.checked and unchecked(found.models, found.checks))
        write_models(found.models, folder / SPARSE)
        write_models(found.alternative, folder / ALTERNATIVE)
        write_figures(folder / FIGURES, figures)

    models = [fingerprint(model) for each in made if each is not None for model in each.models]
    key = digest(verified.key, *mapping_settings(given), models, sorted(without))
    folder = kept.folder.stage("selected", key, compute)
    if any(unread):
        kept.folder.forget_stage("selected")  # a photo could not be read; perhaps it can next time
    return SelectedModels(read_figures(folder / FIGURES, MappingFigures), folder, key)


def _selected(
    given: MatchedPhotos,
    mapper: Mapper,
    best: MappedModels,
    other: MappedModels | None,
    without: Collection[Step],
) -> _Selected:
    checker, parts = mapper.checker(best.database), list[list[str]]()
    whole = best
    if best.is_inconsistent() and "split" not in without:
        found = split_inconsistent(best.models, best.checks, checker, given.options)
        best = dataclasses.replace(best, models=found.models, checks=found.checks)
        parts = found.split_groups
    apart = best.apart(mapper.following())
    checks: list[ModelCheck | None] = [
        done
        and dataclasses.replace(
            done.check,
            apart=[list(pair) for pair in sorted(apart) if done.check.photos() >= set(pair)],
            split_groups=parts,
        )
        for done in best.checks
    ]
    if "pose-ambiguity" not in without:
        checks = _with_pose_ambiguities(checker, best, checks)
    if not checks or checks[0] is None:
        return _Selected(best.models, checks, [])
    split = repeats(parts)
    shown = whole if split else other
    told = _alternative(shown, whole=split, check=checks[0], best=best)
    if shown is None or told is None:
        return _Selected(best.models, checks, [])
    checks[0] = dataclasses.replace(checks[0], alternative=told)
    return _Selected(best.models, checks, mapper.with_points_for_good(shown))


def _with_pose_ambiguities(
    checker: Checker, best: MappedModels, checks: Sequence[ModelCheck | None]
) -> list[ModelCheck | None]:
    """The checks with the second places of photos."""
    return [
        done
        and check
        and (
            remark(
                "whether the poses of photos are ambiguous",
                functools.partial(checker.with_pose_ambiguities, model, done, check),
            )
            or check
        )
        for model, done, check in zip(best.models, best.checks, checks, strict=True)
    ]


def _alternative(
    other: MappedModels | None, *, whole: bool, check: ModelCheck, best: MappedModels
) -> Alternative | None:
    """What another mapping says of the best model; None if the two agree, or if its photos
    contradict each other: then it explains them no better.

    Args:
      other: the mapping; None if there is no other one.
      whole: whether the best model is a part of its largest model.
      check: that of the best model.
      best: the best mapping.
    """
    if other is None or not other.models:
        return None
    theirs, now = model_poses(other.models[0]), check.photos()
    if whole:
        elsewhere = sorted(theirs.keys() - now)
    elif other.contradicted():
        return None
    else:
        ours = model_poses(best.models[0])
        same, *others = groups({n: p for n, p in ours.items() if n in theirs}, theirs) or [[]]
        if len(same) >= SAME_SHARE * len(ours.keys() & theirs.keys()):
            return None
        elsewhere = sorted(name for group in others for name in group)
    return Alternative(
        basis=other.trust.basis,
        images=len(theirs),
        elsewhere=elsewhere,
        contradicted=other.contradicted(),
        whole=whole,
    )


class SplitModels(NamedTuple):
    """Models and their checks, and what they were made from."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first."""
    checks: list[Checked | None]
    split_groups: list[list[str]]
    """The photos of each part that was taken out of a model with photos that they contradict, the
    largest first."""


def split_inconsistent(
    models: "Sequence[pycolmap.Reconstruction]",
    checks: Sequence[Checked | None],
    checker: Checker,
    options: MapOptions,
) -> SplitModels:
    """Take models apart whose photos do not all agree, until all do.

    Photos of two parts contradict each other, or next to nothing holds them together: they do not
    agree about any surface, and they have few points in common. False pairs can join such photos,
    and nothing in them says that they belong together.

    What is left of a model is adjusted without the photos that had been joined to it wrongly, and
    checked again. Photos of parts with fewer than `MIN_VIEWS` are in no model any more. A model
    stays as it is if no part of it would be left.
    """
    made: list[CheckedModel] = []
    groups: list[list[str]] = []
    for each in zip(models, checks, strict=True):
        parts, names = _components(each, checker, options)
        made += parts
        groups += names
    if groups:
        made.sort(key=lambda each: -each[0].num_reg_images())
    return SplitModels(
        [model for model, _ in made],
        [done for _, done in made],
        sorted(groups, key=lambda group: (-len(group), group)),
    )


def _components(
    whole: CheckedModel, checker: Checker, options: MapOptions
) -> tuple[list[CheckedModel], list[list[str]]]:
    """The parts of a model, and the photos of each part, also of those that are too small.

    If the model stays whole, it is the only part, and no photos are split off.
    """
    model, done = whole
    made: list[CheckedModel] = []
    groups: list[list[str]] = []
    for part in done.components if done is not None and len(done.components) > 1 else ():
        names: list[list[str]] = []
        if len(part) >= MIN_VIEWS:
            alone = adjusted_component(
                model, part, loss_px=UNREFINED_LOSS_PX * options.scale, options=options
            )
            (again,) = checker.check([alone])
            if again is not None:
                parts, names = _components((alone, again), checker, options)
                made += parts
        groups += names or [part]
    if not made:
        return [whole], []
    contradicted = done is not None and bool(done.check.contradictions)
    return made, groups if contradicted else []


def adjusted_component(
    model: "pycolmap.Reconstruction",
    names: Sequence[str],
    *,
    loss_px: float,
    options: MapOptions,
) -> "pycolmap.Reconstruction":
    """A model with these photos alone, adjusted without the others.

    Args:
      loss_px: as in `jaxsfm.colmap.bundle_adjustment.bundle_adjust`.
    """
    part = part_of(model, names)
    bundle_adjust(
        part,
        loss_px=loss_px,
        refine_intrinsics=options.refine_intrinsics,
        threads=options.threads,
        held=options.held,
    )
    return part
