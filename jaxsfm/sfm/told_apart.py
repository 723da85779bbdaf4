"""Models in which photos contradict each other, taken apart into models in which none do."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.mapper import MapOptions, part_of
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import MIN_VIEWS
from jaxsfm.sfm.checker import Checker

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
    """The photos of each part that was taken out of a model, the largest first."""


def told_apart(
    models: "Sequence[pycolmap.Reconstruction]",
    checks: Sequence[Checked | None],
    checker: Checker,
    options: MapOptions,
) -> Parts:
    """Take models apart whose photos contradict each other, until none do.

    What is left of a model is adjusted without the photos that had been joined to it wrongly, and
    checked again. Photos of parts with fewer than `MIN_VIEWS` are in no model any more. A model
    stays as it is if no part of it would be left.
    """
    found: list[tuple[pycolmap.Reconstruction, Checked | None]] = []
    groups: list[list[str]] = []
    waiting = list(zip(models, checks, strict=True))
    while waiting:
        model, done = waiting.pop(0)
        made = [] if done is None else _parts(model, done, checker, options)
        if done is None or not made:
            found.append((model, done))
        else:
            groups += done.parts
            waiting += made
    if groups:
        found.sort(key=lambda each: -each[0].num_reg_images())
    # A part that was taken apart again is not a group.
    last = [group for group in groups if not any(set(g) < set(group) for g in groups)]
    return Parts(
        [model for model, _ in found],
        [done for _, done in found],
        sorted(last, key=lambda group: (-len(group), group)),
    )


def _parts(
    model: "pycolmap.Reconstruction", done: Checked, checker: Checker, options: MapOptions
) -> "list[tuple[pycolmap.Reconstruction, Checked]]":
    """The parts of a model, checked; none if it is whole, or if all are too small."""
    made = []
    for part in done.parts if len(done.parts) > 1 else ():
        if len(part) < MIN_VIEWS:
            continue
        alone = part_of(model, part)
        bundle_adjust(
            alone,
            loss_px=LOSS_PX * options.scale,
            refine_intrinsics=options.refine_intrinsics,
            threads=options.threads,
        )
        (again,) = checker.check([alone], ())
        if again is not None:
            made.append((alone, again))
    return made
