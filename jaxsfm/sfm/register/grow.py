"""Registration of new views in finished models, whose poses and points stay as they are.

It works in rounds. In a round, each view is looked for in every model that has views like it, and
gets its place in the model of which it shows most points (`jaxsfm.sfm.register.locate_view`). A
place that too few points hold, or that the view itself or its neighbours contradict, is given up
(`objections`). What it shows beyond the model's points becomes new points
(`jaxsfm.sfm.register.triangulate`), in which the next round locates further views.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.config import Refinement
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.check_model import pair_fits
from jaxsfm.sfm.check.pose_ambiguity import few_points, shown_by
from jaxsfm.sfm.limits import CHECK, REGISTER
from jaxsfm.sfm.photo_order import neighbours
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import FixedStructure, ResectionMatches
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT
from jaxsfm.sfm.register.locate_view import (
    Localization,
    LocatedView,
    UnregisteredView,
    best_location,
    locate_in,
)
from jaxsfm.sfm.register.triangulate import new_points


class ExtendedModels(NamedTuple):
    """Models with new views."""

    models: list[Model]
    """In the order in which they were given. The old views of each come first, and so do its old
    points."""
    registered: dict[str, int]
    """The new views in the order of their rounds, and the index of the model of each."""
    located: dict[str, Localization]
    """For every unregistered view, the outcome of its last attempt, in the model where most speaks
    for it."""
    rounds: int


def grow(
    models: Sequence[Model],
    unregistered: Mapping[str, UnregisteredView],
    resection: ResectionMatches,
    images: DeviceImages,
    *,
    refinement: Refinement | None,
    on_view: Callable[[], None] = lambda: None,
) -> ExtendedModels:
    """Register views until no other view has a place that can be trusted. The views of one round
    are located without each other.

    Args:
      models: one at least.
      resection: matches of unregistered views with views and with each other.
      images: those of all these views, in working pixels.
      refinement: that of the models; None: they were not refined.
      on_view: called for every view that is registered.
    """
    models, registered, matches = list(models), dict[str, int](), resection.matches
    tried: dict[str, dict[int, LocatedView | None]] = {name: {} for name in unregistered}
    rounds, latest = 0, set[str]()
    while True:
        fresh: dict[str, LocatedView] = {}
        now = [latest & {view.name for view in model.views} for model in models]
        for name in sorted(unregistered.keys() - registered.keys()):
            each, known = unregistered[name], tried[name]
            for k in range(len(models)):
                if k in known and not now[k].intersection(each.shortlist):
                    continue  # nothing new since the last attempt
                place = locate_in(
                    models,
                    k,
                    each,
                    resection,
                    images,
                    refinement=refinement or Refinement(),
                )
                known[k] = place and place._replace(found=_held(place.found))
            best = best_location(known.values())
            if best.found.trusted:
                fresh[name] = best
        if not fresh:
            located = {name: best_location(known.values()).found for name, known in tried.items()}
            return ExtendedModels(models, registered, located, rounds)
        stay = dict[str, LocatedView]()
        for k in sorted({place.model for place in fresh.values()}):
            own = {name: place for name, place in fresh.items() if place.model == k}
            against = objections(
                FixedStructure(
                    _with_registered(models[k], own), images, refinement or Refinement()
                ),
                {name: place.found.rests_on_details for name, place in own.items()},
                neighbours(matches.keys()),
                matches,
            )
            for name, why in against.items():
                place = own.pop(name)
                tried[name][k] = place._replace(found=place.found.refused(why))
            if own:
                model = _with_registered(models[k], own)
                more = new_points(model, own, matches, images, refinement=refinement)
                models[k] = model.with_tracks(model.tracks.joined(more))
            stay |= own
        rounds, latest = rounds + 1, set(stay)
        registered |= {name: place.model for name, place in stay.items()}
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


def objections(
    whole: FixedStructure,
    details: Mapping[str, bool],
    following: Collection[Pair],
    matches: Mapping[Pair, PairResult],
) -> dict[str, str]:
    """What speaks against the places of new views in a model, in words, by the name of the view.

    Where a photo shows a copy of what the model shows, alignment confirms a wrong place. The check
    of the mapper's model has not seen this photo. All points of a registered view come from other
    views. So it can only contradict them, and they cannot contradict it.

    Args:
      whole: the model with the registered views.
      details: by the name of each registered view, whether its place rests on details at full size.
        If not, noise hides them there, and what the view does not show says nothing.
      following: pairs of photos that follow each other and that COLMAP verified.
      matches: of these pairs at least, original pixels.
    """
    pairs = [pair for pair in following if details.keys() & set(pair)]
    fits = pair_fits(whole.model, whole.normals, matches, pairs)
    few, found = few_points(whole), {}
    for pair in sorted(pair for pair, fit in fits.items() if fit < CHECK.fit):
        for name in details.keys() & set(pair):
            (other,) = set(pair) - {name}
            found[name] = f"its matches with its neighbour {shown_name(other)} do not agree with it"
    for k, view in enumerate(whole.model.views):
        if view.name in found or not details.get(view.name):
            continue
        tested, contradicted = shown_by(few, k)
        if contradicted >= max(REGISTER.least_contradicted, REGISTER.contradicted_share * tested):
            found[view.name] = (
                f"of {tested} points that it should show there, it shows something else instead of "
                f"{contradicted}"
            )
    return found


def _with_registered(model: Model, fresh: Mapping[str, LocatedView]) -> Model:
    """The model with views that have been registered in it, and what they show of its points."""
    views, parts = list(model.views), [model.tracks.observations]
    for _, place in sorted(fresh.items()):
        found = place.found
        assert found.view is not None and found.points is not None
        parts.append(found.points.observations(len(views), place.rows))
        views.append(found.view)
    return model.with_views(views).with_tracks(Tracks.from_parts(model.tracks.points, parts))
