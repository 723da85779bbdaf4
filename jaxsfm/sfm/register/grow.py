"""Registration of new views in finished models, whose poses and points stay as they are.

It works in rounds. In a round, each view is looked for in every model that has views like it, and
gets its place in the model of which it shows most points (`jaxsfm.sfm.register.place`).
Places that the view itself or its neighbours contradict are given up
(`jaxsfm.sfm.check.placed_views`). What it shows beyond the model's points becomes new points
(`jaxsfm.sfm.register.triangulate`), in which the next round locates further views.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.placed_views import Placed, doubts
from jaxsfm.sfm.photo_order import neighbours
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT
from jaxsfm.sfm.register.locate_view import Localization
from jaxsfm.sfm.register.place import Place, UnregisteredView, best_place, place_in
from jaxsfm.sfm.register.triangulate import new_points


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
    """Register views until no other view has a place that can be trusted. The views of one round
    are located without each other.

    Args:
      models: one at least.
      matches: of unregistered views with views and with each other, original pixels.
      images: those of all these views, in working pixels.
      refinement: that of the models; None: they were not refined.
      on_view: called for every view that is registered.
    """
    models, placed = list(models), dict[str, int]()
    tried: dict[str, dict[int, Place | None]] = {name: {} for name in unregistered}
    rounds, latest = 0, set[str]()
    while True:
        fresh: dict[str, Place] = {}
        now = [latest & {view.name for view in model.views} for model in models]
        for name in sorted(unregistered.keys() - placed.keys()):
            each, known = unregistered[name], tried[name]
            for k in range(len(models)):
                if k in known and not now[k].intersection(each.shortlist):
                    continue  # nothing new since the last attempt
                place = place_in(
                    models,
                    k,
                    each,
                    matches,
                    images,
                    refinement=refinement or Refinement(),
                    seed=seed,
                )
                known[k] = place and place._replace(found=_held(place.found))
            best = best_place(known.values())
            if best.found.trusted:
                fresh[name] = best
        if not fresh:
            located = {name: best_place(known.values()).found for name, known in tried.items()}
            return ExtendedModels(models, placed, located, rounds)
        stay = dict[str, Place]()
        for k in sorted({place.model for place in fresh.values()}):
            own = {name: place for name, place in fresh.items() if place.model == k}
            against = _against(_with_placed(models[k], own), own, matches, images, refinement)
            for name, why in against.items():
                place = own.pop(name)
                tried[name][k] = place._replace(found=place.found.refused(why))
            if own:
                model = _with_placed(models[k], own)
                more = new_points(model, own, matches, images, refinement=refinement)
                models[k] = model.with_tracks(model.tracks.joined(more))
            stay |= own
        rounds, latest = rounds + 1, set(stay)
        placed |= {name: place.model for name, place in stay.items()}
        for _ in stay:
            on_view()


def _held(located: Localization) -> Localization:
    """The outcome, which is not trusted if too few points hold the view.

    Such a view would carry the points that it adds, and the views that later rounds place on them.
    The refinement asks as much of a view that the mapper has left out
    (docs/decisions/weak-views.md#photos-that-nothing-confirms).
    """
    count = 0 if located.points is None else len(located.points.rows)
    if not located.trusted or count >= MIN_COUNT:
        return located
    return located.refused(
        f"alignment finds {located.agreed} of the {located.candidates} points that it would show "
        f"there, but only {count} of them hold it (needed: {MIN_COUNT})"
    )


def _against(
    model: Model,
    own: Mapping[str, Place],
    matches: Mapping[Pair, PairResult],
    images: DeviceImages,
    refinement: Refinement | None,
) -> dict[str, str]:
    """What speaks against the places of new views in a model, in words, by name."""
    details = {name: place.found.rests_on_details for name, place in own.items()}
    placed = Placed(details, neighbours(matches.keys()), matches)
    return doubts(model, images, refinement or Refinement(), placed)


def _with_placed(model: Model, fresh: Mapping[str, Place]) -> Model:
    """The model with views that have been placed in it, and what they show of its points."""
    views, parts = list(model.views), [model.tracks.observations]
    for _, place in sorted(fresh.items()):
        found = place.found
        assert found.view is not None and found.points is not None
        parts.append(found.points.observations(len(views), place.rows))
        views.append(found.view)
    return model.with_views(views).with_tracks(Tracks.from_parts(model.tracks.points, parts))
