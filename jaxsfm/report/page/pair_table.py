"""The tables of refused pairs and of groups of photos."""

from typing import NamedTuple

import numpy as np

from jaxsfm.report.page.pair_states import STATES, State, refused_pairs, state
from jaxsfm.report.run_results import Component, PairRow, ViewGraph
from jaxsfm.report.summary import MAX_GROUPS

MAX_PAIRS = 15
"""The most rows of the table of refused pairs."""


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
