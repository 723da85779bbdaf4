"""How far the pairs of photos came: the states of pairs with their colours, and the tables."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxsfm.report.page.figures import BLUE, GREEN, GREY, ORANGE
from jaxsfm.report.run_results import Component, PairRow, ViewGraph
from jaxsfm.report.summary import MAX_GROUPS

MAX_PAIRS = 15
"""The most rows of the table of refused pairs."""


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
    State(
        "not trusted",
        "COLMAP verified it, but stronger pairs or the check of the model contradict it",
        ORANGE,
    ),
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


class PairTable(NamedTuple):
    """How far all pairs came."""

    counts: list[tuple[State, int]]
    """The number of pairs in every state that occurs."""
    refused: list[tuple[PairRow, str]]
    """The refused pairs with the most matches, and why each was refused."""
    left_out: int
    """The number of refused pairs that have no row."""


def pair_table(rows: list[PairRow]) -> PairTable:
    """How far all pairs came, and the reasons why pairs with many matches were refused."""
    refused = refused_pairs(rows)
    numbers = np.bincount([state(row) for row in rows], minlength=len(STATES)).tolist()
    shown = []
    for row in refused[:MAX_PAIRS]:
        name, meaning, _ = STATES[state(row)]
        reason = row.view_graph.reason if row.view_graph else ""
        shown.append((row, f"{name}: {reason or meaning}"))
    return PairTable(
        counts=[(each, n) for each, n in zip(STATES, numbers, strict=True) if n],
        refused=shown,
        left_out=max(0, len(refused) - MAX_PAIRS),
    )


def component_table(view_graph: ViewGraph) -> list[Component]:
    """The groups of photos that trusted pairs join, the largest first; nothing if there is one
    group only. Single photos have no row: they are listed among the lost photos."""
    groups = view_graph.components
    if len(groups) < 2:
        return []
    return [group for group in groups if len(group.images) > 1][:MAX_GROUPS]
