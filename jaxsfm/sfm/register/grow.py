"""Registration of new views in finished models, whose poses and points stay as they are.

It works in rounds. In a round, each view is located in every model that has views like it
(`jaxsfm.sfm.register.locate_view`), and gets its place in the model of which it shows most points.
What it shows beyond the model's points becomes new points (`jaxsfm.sfm.register.triangulate`), in
which the next round locates further views.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT
from jaxsfm.sfm.register.locate_view import Localization, locate
from jaxsfm.sfm.register.triangulate import new_points


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


class ExtendedModels(NamedTuple):
    """Models with new views."""

    models: list[Model]
    """In the order in which they were given. The old views of each come first, and so do its old
    points."""
    placed: dict[str, int]
    """The new views in the order of their rounds, and the index of the model of each."""
    located: dict[str, Localization]
    """For every unregistered view, the outcome of its last attempt, in the model where most speaks
    for it."""
    rounds: int


def grow(
    models: Sequence[Model],
    unregistered: Mapping[str, UnregisteredView],
    matches: Mapping[Pair, PairResult],
    images: DeviceImages,
    *,
    refinement: Refinement | None,
    seed: int = 0,
    on_view: Callable[[], None] = lambda: None,
) -> ExtendedModels:
    """Register views until a round registers none. The views of one round do not see each other.

    Args:
      models: one at least.
      matches: of unregistered views with views and with each other, original pixels.
      images: those of all these views, in working pixels.
      refinement: that of the models; None: they were not refined.
      on_view: called for every view that is registered.
    """
    models, placed = list(models), dict[str, int]()
    tried: dict[str, dict[int, Place]] = {name: {} for name in unregistered}
    rounds, latest = 0, set[str]()

    def attempt(name: str, k: int, around: Sequence[str]) -> Place:
        each = unregistered[name]
        part, rows = models[k].part(around)
        located = locate(
            each.views[k],
            part,
            matches_with(name, around, matches),
            images,
            refinement=refinement or Refinement(),
            own_camera=each.own_camera,
            seed=seed,
        )
        return Place(k, _held(located), rows)

    while True:
        fresh: list[dict[str, Place]] = [{} for _ in models]
        names = [{view.name for view in model.views} for model in models]
        for name in sorted(unregistered.keys() - placed.keys()):
            known = tried[name]
            for k in range(len(models)):
                around = [other for other in unregistered[name].shortlist if other in names[k]]
                # The first model is tried in any case, so that each view has an outcome.
                if (around or k == 0) and (k not in known or set(around) & latest):
                    known[k] = attempt(name, k, around)
            best = best_place(known.values())
            if best.found.trusted:
                fresh[best.model][name] = best
                on_view()
        latest = {name for places in fresh for name in places}
        if not latest:
            located = {name: best_place(known.values()).found for name, known in tried.items()}
            return ExtendedModels(models, placed, located, rounds)
        rounds += 1
        placed |= {name: k for k, places in enumerate(fresh) for name in sorted(places)}
        for k, places in enumerate(fresh):
            if places:
                models[k] = _with_placed(models[k], places)
                more = new_points(models[k], places, matches, images, refinement=refinement)
                models[k] = models[k].with_tracks(models[k].tracks.joined(more))


def _held(located: Localization) -> Localization:
    """The outcome, which is not trusted if too few points hold the view.

    Such a view would carry the points that it adds, and the views that later rounds place on them.
    The refinement asks as much of a view that the mapper has left out
    (docs/decisions/weak-views.md#photos-of-another-place).
    """
    count = 0 if located.points is None else len(located.points.rows)
    if not located.trusted or count >= MIN_COUNT:
        return located
    why = (
        f"alignment finds {located.agreed} of the {located.candidates} points that it would show "
        f"there, but only {count} of them hold it (needed: {MIN_COUNT})"
    )
    return dataclasses.replace(located, trusted=False, why=why)


def best_place(places: Iterable[Place]) -> Place:
    """The place with most support; of equals, the one in the first model."""
    return max(places, key=lambda place: (place.found.support, -place.model))


def matches_with(
    name: str, others: Sequence[str], matches: Mapping[Pair, PairResult]
) -> dict[Pair, PairResult]:
    """The matches of one image with others, by pair."""
    pairs = [make_pair(name, other) for other in others]
    return {pair: matches[pair] for pair in pairs if pair in matches}


def _with_placed(model: Model, fresh: Mapping[str, Place]) -> Model:
    """The model with views that have been placed in it, and what they show of its points."""
    views, parts = list(model.views), [model.tracks.observations]
    for _, place in sorted(fresh.items()):
        found = place.found
        assert found.view is not None and found.points is not None
        parts.append(found.points.observations(len(views), place.rows))
        views.append(found.view)
    return model.with_views(views).with_tracks(Tracks.from_parts(model.tracks.points, parts))
