"""Models taken apart into parts in which photos agree with each other.

Photos of two parts contradict each other, or next to nothing holds them together: they do not agree
about any surface, and they have few points in common. False pairs can join such photos, and nothing
in them says that they belong together.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_images import part_of
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import MIN_VIEWS
from jaxsfm.sfm.checker import CheckedModel, Checker

if TYPE_CHECKING:
    import pycolmap

LOSS_PX = 2.0
"""Scale of the loss of the bundle adjustment, working pixels. Keypoints that are not refined are
one or two pixels off, and false matches of the former model much further."""


class Parts(NamedTuple):
    """Models and their checks, and what they were made from."""

    models: "list[pycolmap.Reconstruction]"
    """The one with most images first."""
    checks: list[Checked | None]
    told_apart: list[list[str]]
    """The photos of each part that was taken out of a model with photos that they contradict, the
    largest first."""


def told_apart(
    models: "Sequence[pycolmap.Reconstruction]",
    checks: Sequence[Checked | None],
    checker: Checker,
    options: MapOptions,
) -> Parts:
    """Take models apart whose photos do not all agree, until all do.

    What is left of a model is adjusted without the photos that had been joined to it wrongly, and
    checked again. Photos of parts with fewer than `MIN_VIEWS` are in no model any more. A model
    stays as it is if no part of it would be left.
    """
    made: list[CheckedModel] = []
    groups: list[list[str]] = []
    for each in zip(models, checks, strict=True):
        parts, names = _parts(each, checker, options)
        made += parts
        groups += names
    if groups:
        made.sort(key=lambda each: -each[0].num_reg_images())
    return Parts(
        [model for model, _ in made],
        [done for _, done in made],
        sorted(groups, key=lambda group: (-len(group), group)),
    )


def _parts(
    whole: CheckedModel, checker: Checker, options: MapOptions
) -> tuple[list[CheckedModel], list[list[str]]]:
    """The parts of a model, and the photos of each part, also of those that are too small.

    If the model stays whole, it is the only part, and no photos are told apart.
    """
    model, done = whole
    made: list[CheckedModel] = []
    groups: list[list[str]] = []
    for part in done.parts if done is not None and len(done.parts) > 1 else ():
        names: list[list[str]] = []
        if len(part) >= MIN_VIEWS:
            alone = adjusted_part(model, part, loss_px=LOSS_PX * options.scale, options=options)
            (again,) = checker.check([alone])
            if again is not None:
                parts, names = _parts((alone, again), checker, options)
                made += parts
        groups += names or [part]
    if not made:
        return [whole], []
    contradicted = done is not None and bool(done.check.contradictions)
    return made, groups if contradicted else []


def adjusted_part(
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
    )
    return part
