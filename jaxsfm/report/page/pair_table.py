"""The tables of refused pairs and of groups of photos."""

from typing import NamedTuple

import numpy as np

from jaxsfm.report.page.pair_states import STATES, State, refused_pairs, state
from jaxsfm.report.run_results import Component, PairRow, ViewGraph
from jaxsfm.report.summary import MAX_GROUPS, named

MAX_PAIRS = 15
"""The most rows of the table of refused pairs."""
MAX_NAMES = 8
"""The most photos of a group that are named."""


class RefusedPair(NamedTuple):
    """A pair with matches that the model does not rest on."""

    row: PairRow
    state: State
    reason: str


class PairTable(NamedTuple):
    """How far all pairs came."""

    counts: list[tuple[State, int]]
    """The number of pairs in every state that occurs."""
    refused: list[RefusedPair]
    """The refused pairs with the most matches."""
    left_out: int
    """The number of refused pairs that have no row."""


class PhotoGroupRow(NamedTuple):
    """A group of photos that trusted pairs join."""

    group: Component
    names: str


def pair_table(rows: list[PairRow]) -> PairTable:
    """How far all pairs came, and the reasons why pairs with many matches were refused."""
    refused = refused_pairs(rows)
    numbers = np.bincount([state(row) for row in rows], minlength=len(STATES)).tolist()
    shown = []
    for row in refused[:MAX_PAIRS]:
        own = STATES[state(row)]
        reason = row.view_graph.reason if row.view_graph else ""
        shown.append(RefusedPair(row, own, reason or own.meaning))
    return PairTable(
        counts=[(each, n) for each, n in zip(STATES, numbers, strict=True) if n],
        refused=shown,
        left_out=max(0, len(refused) - MAX_PAIRS),
    )


def component_table(view_graph: ViewGraph) -> list[PhotoGroupRow]:
    """The groups of photos that trusted pairs join, the largest first; nothing if there is one
    group only. Single photos have no row: they are listed among the lost photos."""
    groups = view_graph.components
    if len(groups) < 2:
        return []
    several = [group for group in groups if len(group.images) > 1]
    return [PhotoGroupRow(group, named(group.images, MAX_NAMES)) for group in several[:MAX_GROUPS]]
