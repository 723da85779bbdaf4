"""How far a pair of photos came, with the names and colours of the page."""

from collections.abc import Iterable
from typing import NamedTuple

from jaxsfm.report.page.figures import BLUE, GREEN, GREY, ORANGE
from jaxsfm.report.run_results import PairRow


class State(NamedTuple):
    """One of the stages at which a pair can end."""

    name: str
    meaning: str
    colour: str


NOT_TRIED, NO_PLANE, NOT_HANDED_ON, NOT_VERIFIED, NOT_TRUSTED, USED = range(6)
STATES = (
    State("not tried", "the pair was not compared", "#00000000"),
    State("no plane", "too few matches, or too few on a common plane", "#8a94a344"),
    State("not chosen", "it has matches, but --best-pairs left it out", GREY),
    State("not verified", "it has matches, but COLMAP found no common geometry", "#c9b458"),
    State("not trusted", "COLMAP verified it, but stronger pairs contradict it", ORANGE),
    State("used", "COLMAP verified it, and it was given to the mapper", BLUE),
)
REGISTERED, LOST = GREEN, "#d1435b"
"""Colours of photos with and without a pose."""


def state(row: PairRow) -> int:
    """The place of a pair's state in STATES."""
    if not row.inliers:
        return NO_PLANE
    if not row.handed_on:
        return NOT_HANDED_ON
    if not row.colmap_inliers:
        return NOT_VERIFIED
    return USED if row.trusted else NOT_TRUSTED


def partners(names: Iterable[str], rows: Iterable[PairRow]) -> dict[str, int]:
    """The number of used pairs of every photo."""
    number = dict.fromkeys(names, 0)
    for row in rows:
        if state(row) == USED:
            for name in row.pair:
                number[name] += 1
    return number


def strength(row: PairRow, most: int) -> float:
    """A pair's strength, 0 .. 1.

    It is that of the view graph. Without a view graph it is the number of COLMAP's inliers, divided
    by `most`, the largest number that a pair has.
    """
    return row.view_graph.strength if row.view_graph else row.colmap_inliers / max(most, 1)


def refused_pairs(rows: list[PairRow]) -> list[PairRow]:
    """The pairs with matches that the model does not rest on, those with most matches first."""
    refused = [row for row in rows if state(row) in (NOT_TRUSTED, NOT_VERIFIED)]
    return sorted(refused, key=lambda row: (-row.colmap_inliers, -row.inliers, row.pair))
