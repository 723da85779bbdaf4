"""A finished model that grows by new views: what it has stays as it is.

Round by round: views are placed on what there is (`jaxsfm.sfm.register.locate_view`), then what
they show beside it becomes new points (`jaxsfm.sfm.register.triangulate`), on which the next round
places further ones.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Tracks, View, part_of
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.register.locate_view import Localization, locate
from jaxsfm.sfm.register.triangulate import new_points


class UnregisteredView(NamedTuple):
    """A view that has no pose yet."""

    view: View
    """Its pose does not count."""
    own_camera: bool
    """Its focal length is estimated."""
    shortlist: Sequence[str]
    """Views that it is matched with."""


class ExtendedModel(NamedTuple):
    """A model with new views."""

    views: list[View]
    """The old ones first."""
    tracks: Tracks
    """The old points first."""
    placed: list[str]
    """In the order of their rounds."""
    located: dict[str, Localization]
    """What became of every newcomer at its last attempt."""
    rounds: int


def grow(
    views: list[View],
    tracks: Tracks,
    newcomers: Mapping[str, UnregisteredView],
    matches: Mapping[Pair, PairResult],
    read: Reader,
    *,
    refinement: Refinement | None,
    seed: int = 0,
    on_view: Callable[[], None] = lambda: None,
) -> ExtendedModel:
    """Place newcomers until a round places none. Those of one round do not see each other.

    Args:
      views, tracks: of the model, working pixels.
      matches: of newcomers with views and with each other, original pixels.
      refinement: the model's; None: it was not refined.
      on_view: told of every view that is placed.
    """
    placed: list[str] = []
    located: dict[str, Localization] = {}
    rounds, latest = 0, set()
    while True:
        fresh = {}
        names = {view.name for view in views}
        for name in sorted(newcomers.keys() - set(placed)):
            each = newcomers[name]
            around = [other for other in each.shortlist if other in names]
            if name in located and not set(around) & latest:
                continue  # nothing new since its last attempt
            part, structure, rows = part_of(views, tracks, around)
            located[name] = locate(
                each.view,
                part,
                structure,
                matches_with(name, around, matches),
                read,
                config=refinement or Refinement(),
                own_camera=each.own_camera,
                seed=seed,
            )
            if located[name].trusted:
                fresh[name] = rows
                on_view()
        if not fresh:
            return ExtendedModel(views, tracks, placed, located, rounds)
        rounds += 1
        views, tracks = _joined(views, tracks, {name: located[name] for name in fresh}, fresh)
        placed += sorted(fresh)
        latest = set(fresh)
        more = new_points(views, tracks, fresh, matches, read, refinement=refinement)
        tracks = Tracks(
            np.concatenate([tracks.points, more.points]),
            np.concatenate([tracks.point, more.point + len(tracks.points)]),
            np.concatenate([tracks.view, more.view]),
            np.concatenate([tracks.xy, more.xy]),
        )


def matches_with(
    name: str, others: Sequence[str], matches: Mapping[Pair, PairResult]
) -> dict[Pair, PairResult]:
    """Those of one image with others."""
    pairs = [make_pair(name, other) for other in others]
    return {pair: matches[pair] for pair in pairs if pair in matches}


def _joined(
    views: list[View],
    tracks: Tracks,
    located: Mapping[str, Localization],
    rows: Mapping[str, np.ndarray],
) -> tuple[list[View], Tracks]:
    """The model with views that have found their poses, and what they show of its points.

    Args:
      rows: for each, which of the model's points its part had.
    """
    every, parts = list(views), [(tracks.point, tracks.view, tracks.xy)]
    for name, found in sorted(located.items()):
        assert found.view is not None and found.observed is not None
        seen = found.observed
        parts.append((rows[name][seen.rows], np.full(len(seen.rows), len(every)), seen.xy))
        every.append(found.view)
    point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    return every, Tracks(tracks.points, point, view, xy)
