"""Registration of new views in a finished model, whose poses and points stay as they are.

It works in rounds. In a round, views are located in the model (`jaxsfm.sfm.register.locate_view`).
What they show beyond the model's points becomes new points (`jaxsfm.sfm.register.triangulate`), in
which the next round locates further views.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.register.locate_view import Localization, locate
from jaxsfm.sfm.register.triangulate import new_points


class UnregisteredView(NamedTuple):
    """A view that is not in the model."""

    view: View
    """Its pose plays no part."""
    own_camera: bool
    """Its focal length is estimated."""
    shortlist: Sequence[str]
    """Names of the views that it is matched with."""


class ExtendedModel(NamedTuple):
    """A model with new views."""

    model: Model
    """The old views come first, and so do the old points."""
    placed: list[str]
    """Names of the new views, in the order of their rounds."""
    located: dict[str, Localization]
    """For every unregistered view, the outcome of its last attempt."""
    rounds: int


def grow(
    model: Model,
    unregistered: Mapping[str, UnregisteredView],
    matches: Mapping[Pair, PairResult],
    images: DeviceImages,
    *,
    refinement: Refinement | None,
    seed: int = 0,
    on_view: Callable[[], None] = lambda: None,
) -> ExtendedModel:
    """Register views until a round registers none. The views of one round do not see each other.

    Args:
      matches: of unregistered views with views and with each other, original pixels.
      images: those of all these views, in working pixels.
      refinement: the model's; None: it was not refined.
      on_view: called for every view that is registered.
    """
    placed: list[str] = []
    located: dict[str, Localization] = {}
    rounds, latest = 0, set()
    while True:
        fresh = {}
        names = {view.name for view in model.views}
        for name in sorted(unregistered.keys() - set(placed)):
            each = unregistered[name]
            around = [other for other in each.shortlist if other in names]
            if name in located and not set(around) & latest:
                continue  # nothing new since its last attempt
            part, rows = model.part(around)
            located[name] = locate(
                each.view,
                part,
                matches_with(name, around, matches),
                images,
                refinement=refinement or Refinement(),
                own_camera=each.own_camera,
                seed=seed,
            )
            if located[name].trusted:
                fresh[name] = rows
                on_view()
        if not fresh:
            return ExtendedModel(model, placed, located, rounds)
        rounds += 1
        model = _with_located(model, located, fresh)
        placed += sorted(fresh)
        latest = set(fresh)
        more = new_points(model, fresh, matches, images, refinement=refinement)
        model = model.with_tracks(model.tracks.joined(more))


def matches_with(
    name: str, others: Sequence[str], matches: Mapping[Pair, PairResult]
) -> dict[Pair, PairResult]:
    """The matches of one image with others, by pair."""
    pairs = [make_pair(name, other) for other in others]
    return {pair: matches[pair] for pair in pairs if pair in matches}


def _with_located(
    model: Model, located: Mapping[str, Localization], fresh: Mapping[str, np.ndarray]
) -> Model:
    """The model with views that have been located, and what they show of its points.

    Args:
      fresh: the views to add. By name: for each point of the part of the model in which it was
        located, the index of that point in the model.
    """
    views, parts = list(model.views), [model.tracks.observations]
    for name, rows in sorted(fresh.items()):
        found = located[name]
        assert found.view is not None and found.points is not None
        parts.append(found.points.observations(len(views), rows))
        views.append(found.view)
    return model.with_views(views).with_tracks(Tracks.from_parts(model.tracks.points, parts))
