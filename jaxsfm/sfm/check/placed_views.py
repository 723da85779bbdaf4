"""Views that the refinement has placed: what speaks against their places.

Where a photo shows a copy of what the model shows, alignment confirms a wrong place. The check of
the mapper's model has not seen this photo. All points of a placed view come from other views. So it
can only contradict them, and they cannot contradict it.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

from jaxsfm.colmap.model import Model
from jaxsfm.config import Refinement
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.check_model import pair_fits
from jaxsfm.sfm.check.other_places import Surface, shown_by
from jaxsfm.sfm.limits import CHECK, REGISTER
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.device_images import DeviceImages


class Placed(NamedTuple):
    """Views that were placed, and the pairs of photos that test their places."""

    full_size: Mapping[str, bool]
    """By the name of the view: whether its place rests on details at full size. If not, noise hides
    them there, and what the view does not show says nothing."""
    neighbours: Collection[Pair]
    """Pairs of photos that follow each other and that COLMAP verified."""
    matches: Mapping[Pair, PairResult]
    """Of these pairs at least, original pixels."""


def doubts(
    model: Model, images: DeviceImages, refinement: Refinement, placed: Placed
) -> dict[str, str]:
    """What speaks against the places of views, in words, by the name of the view.

    Args:
      model: with the placed views.
      images: those of the views, in the model's pixels.
      refinement: how patches are aligned, and when they agree.
    """
    normal = plane_geometry.normals(model, neighbours=refinement.neighbours)
    following = [pair for pair in placed.neighbours if placed.full_size.keys() & set(pair)]
    fits = pair_fits(model, normal, placed.matches, following)
    few, found = Surface(model, normal).few(), {}
    for pair in sorted(pair for pair, fit in fits.items() if fit < CHECK.fit):
        for name in placed.full_size.keys() & set(pair):
            (other,) = set(pair) - {name}
            found[name] = f"its matches with its neighbour {shown_name(other)} do not agree with it"
    for k, view in enumerate(model.views):
        if view.name in found or not placed.full_size.get(view.name):
            continue
        tested, contradicted = shown_by(few, images, refinement, k)
        if contradicted >= max(REGISTER.least_contradicted, REGISTER.contradicted_share * tested):
            found[view.name] = (
                f"of {tested} points that it should show there, it shows something else instead of "
                f"{contradicted}"
            )
    return found
