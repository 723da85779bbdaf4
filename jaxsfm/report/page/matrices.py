"""Two heat maps of all pairs: how many matches a pair has, and how far it came."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from jaxsfm.report.page.figures import Figure, count, figure, short, text
from jaxsfm.report.page.pair_states import NOT_TRIED, STATES, state
from jaxsfm.report.run_results import PairRow

MAX_SQUARES = 200
"""The most squares on a side. If there are more photos, several of them share a square."""
MAX_LABELS = 25


def _reduced(matrix: np.ndarray, block: int) -> np.ndarray:
    """The largest value of every block x block part of a square matrix."""
    n = -(-len(matrix) // block)
    wide = np.zeros((n * block, n * block), matrix.dtype)
    wide[: len(matrix), : len(matrix)] = matrix
    return wide.reshape(n, block, n, block).max((1, 3))


def pair_matrices(names: Sequence[str], rows: Sequence[PairRow]) -> tuple[np.ndarray, np.ndarray]:
    """Two symmetrical matrices int32 (n, n): the numbers of the pairs' matches (COLMAP's inliers
    where it verified a pair), and the places of their states in STATES."""
    index = {name: k for k, name in enumerate(names)}
    inliers = np.zeros((len(names), len(names)), np.int32)
    states = np.zeros_like(inliers)
    for row in rows:
        a, b = (index[name] for name in row.pair)
        inliers[a, b] = inliers[b, a] = row.colmap_inliers or row.inliers
        states[a, b] = states[b, a] = state(row)
    return inliers, states


def matrix_figures(names: list[str], rows: Sequence[PairRow]) -> tuple[Figure, Figure]:
    """Heat maps of the matches and of the states of all pairs; `names` are all photos, in the order
    of the axes."""
    block = max(1, -(-len(names) // MAX_SQUARES))
    inliers, states = (_reduced(m, block) for m in pair_matrices(names, rows))
    shown = short(names)
    groups = [shown[k : k + block] for k in range(0, len(shown), block)]
    labels = [text(g[0] if len(g) == 1 else f"{g[0]} .. {g[-1]}") for g in groups]
    note = f"Each square stands for {block} x {block} photos and shows the best of their pairs."
    every = max(1, -(-len(labels) // MAX_LABELS))
    axis = {
        "type": "category",
        "tickmode": "array",
        "tickvals": np.arange(len(labels))[::every],
        "ticktext": [text(g[0]) for g in groups[::every]],
        "showgrid": False,
        "zeroline": False,
        "automargin": True,
    }
    layout = {
        "xaxis": {**axis, "tickangle": -60},
        "yaxis": {**axis, "autorange": "reversed", "scaleanchor": "x", "constrain": "domain"},
        "margin": {"l": 20, "r": 10, "t": 12, "b": 20},
    }
    there = sorted(set(states.ravel().tolist()) - {NOT_TRIED})
    # The key lists only the states that occur.
    place = np.full(len(STATES), np.nan, np.float32)
    place[there] = np.arange(len(there))
    colours = [
        [edge / len(there), STATES[s].colour] for k, s in enumerate(there) for edge in (k, k + 1)
    ]
    common = {"x": labels, "y": labels, "hoverongaps": False}
    where = "%{x}<br>%{y}"
    matches = go.Heatmap(
        z=np.where(inliers, np.log10(np.maximum(inliers, 1)), np.nan).astype(np.float32),
        customdata=inliers,
        colorscale="Viridis",
        hovertemplate=where + "<br>%{customdata} matches<extra></extra>",
        colorbar=_counts_bar(int(inliers.max(initial=1))),
        **common,
    )
    outcomes = go.Heatmap(
        z=place[states],
        zmin=-0.5,
        zmax=len(there) - 0.5,
        colorscale=colours or None,
        hovertemplate=where + "<extra></extra>",
        colorbar=_bar(range(len(there)), [STATES[k].name for k in there]),
        **common,
    )
    n, note = len(names), note if block > 1 else ""
    return (
        figure([matches], layout, alt=f"Heat map of the matches of {n} x {n} photos", note=note),
        figure(
            [outcomes], layout, alt=f"Heat map of the outcome of the pairs of {n} photos", note=note
        ),
    )


def _counts_bar(most: int) -> dict[str, object]:
    ticks = [k * 10**p for p in range(7) for k in (1, 2, 5) if k * 10**p <= most]
    return _bar(np.log10(ticks).tolist(), [count(k) for k in ticks])


def _bar(at: Sequence[float], labels: list[str]) -> dict[str, object]:
    """The key of the colours. It is above the squares, because narrow screens have no space beside
    them."""
    return {
        "orientation": "h",
        "y": 1.0,
        "yanchor": "bottom",
        "thickness": 10,
        "tickvals": list(at),
        "ticktext": labels,
    }
