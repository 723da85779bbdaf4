"""The place of a view that is in no model: in the one of which it shows most."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import FixedStructure
from jaxsfm.sfm.register.locate_view import Localization, locate, nowhere


class UnregisteredView(NamedTuple):
    """A view that is in no model."""

    views: Sequence[View]
    """The view with the camera that it starts with in each model. Their poses play no part."""
    own_camera: bool
    """Its focal length is estimated."""
    shortlist: Sequence[str]
    """Names of the views that it is matched with."""


class Place(NamedTuple):
    """The outcome of an attempt to find a view's place in a model."""

    model: int
    """Index of the model."""
    found: Localization
    rows: np.ndarray
    """int: for each point of the part of the model in which the view was looked for, the index of
    that point in the model."""


def place_in(
    models: Sequence[Model],
    k: int,
    wanted: UnregisteredView,
    matches: Mapping[Pair, PairResult],
    images: DeviceImages,
    *,
    refinement: Refinement,
    seed: int,
) -> Place | None:
    """Look for a view in one of the models, from its matches with the views of its shortlist.

    Args:
      k: index of the model.
      matches: original pixels.
      images: those of the view and of its shortlist, in working pixels.

    Returns:
      None if no view of its shortlist is in the model.
    """
    names, view = {each.name for each in models[k].views}, wanted.views[k]
    around = [name for name in wanted.shortlist if name in names]
    if not around:
        return None
    part, rows = models[k].part(around)
    pairs = [make_pair(view.name, name) for name in around]
    found = locate(
        view,
        FixedStructure(part, images, refinement),
        {pair: matches[pair] for pair in pairs if pair in matches},
        own_camera=wanted.own_camera,
        seed=seed,
    )
    return Place(k, found, rows)


def best_place(places: Iterable[Place | None]) -> Place:
    """The place with most support; of equals, the one in the first model.

    Without any place, it is nowhere, and its model is the first one.
    """
    tried = [place for place in places if place is not None]
    if not tried:
        return Place(0, nowhere(0, {}), np.zeros(0, int))
    return max(tried, key=lambda place: (place.found.support, -place.model))
