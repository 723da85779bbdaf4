"""The view graph: photos are dots on a circle, pairs are lines."""

from collections.abc import Collection, Sequence

import numpy as np
import plotly.graph_objects as go

from jaxsfm.report.page.figures import BLUE, ORANGE, Figure, figure, short, text
from jaxsfm.report.page.pair_states import (
    LOST,
    NOT_TRUSTED,
    REGISTERED,
    USED,
    partners,
    state,
    strength,
)
from jaxsfm.report.run_results import PairRow

MAX_USED, MAX_NOT_TRUSTED = 1200, 300
"""The most lines of either kind that are drawn, the strongest first."""
BEST_OF_EACH = 2
"""The number of strongest pairs of every photo that are drawn before all others."""
MAX_LABELS = 40
"""The most photos that are labelled with their names."""
BINS = ((0.0, 0.1, 0.8, 0.5), (0.1, 0.4, 1.3, 0.65), (0.4, np.inf, 2.4, 0.9))
"""Classes of strength: from, to, line width in pixels, opacity."""


def chosen_edges(rows: Sequence[PairRow], limit: int, most: int) -> list[PairRow]:
    """At most `limit` pairs: the strongest, but the best pairs of every photo come first."""
    ranked = sorted(rows, key=lambda row: (-strength(row, most), row.pair))
    if len(ranked) <= limit:
        return ranked
    degree: dict[str, int] = {}
    first, rest = [], []
    for row in ranked:
        wanted = any(degree.get(name, 0) < BEST_OF_EACH for name in row.pair)
        (first if wanted else rest).append(row)
        for name in row.pair:
            degree[name] = degree.get(name, 0) + wanted
    return (first + rest)[:limit]


def view_graph(names: list[str], rows: Sequence[PairRow], registered: Collection[str]) -> Figure:
    """The photos around a circle, in the order of their names, and the verified pairs among `rows`.
    The photos `registered` have a pose in the best model."""
    by_state = {k: [row for row in rows if state(row) == k] for k in (USED, NOT_TRUSTED)}
    most = max((row.colmap_inliers for row in rows), default=1)
    used = chosen_edges(by_state[USED], MAX_USED, most)
    odd = chosen_edges(by_state[NOT_TRUSTED], MAX_NOT_TRUSTED, most)
    left_out = sum(map(len, by_state.values())) - len(used) - len(odd)
    angle = 2 * np.pi * np.arange(len(names)) / max(len(names), 1)
    xy = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    at = dict(zip(names, xy, strict=True))

    def lines(some: list[PairRow], name: str, colour: str, width: float, opacity: float):
        gap = np.full(2, np.nan)
        path = [p for row in some for p in (at[row.pair[0]], at[row.pair[1]], gap)]
        points = np.asarray(path, np.float32).reshape(-1, 2)
        return go.Scatter(
            x=points[:, 0],
            y=points[:, 1],
            mode="lines",
            name=f"{name} ({len(some)})",
            line={"color": colour, "width": width},
            opacity=opacity,
            hoverinfo="skip",
        )

    data = [lines(odd, "not trusted", ORANGE, 0.8, 0.35)] if odd else []
    for (low, high, width, opacity), name in zip(BINS, ("weak", "middling", "strong"), strict=True):
        some = [row for row in used if low <= strength(row, most) < high]
        if some:
            data.append(lines(some, name, BLUE, width, opacity))
    labels = [text(name) for name in short(names)]
    number = partners(names, rows)
    for colour, what, wanted in ((REGISTERED, "in the model", True), (LOST, "lost", False)):
        own = [k for k, name in enumerate(names) if (name in registered) == wanted]
        if own:
            data.append(
                go.Scatter(
                    x=xy[own, 0].astype(np.float32),
                    y=xy[own, 1].astype(np.float32),
                    mode="markers+text" if len(names) <= MAX_LABELS else "markers",
                    name=f"{what} ({len(own)})",
                    marker={"color": colour, "size": 9 if len(names) <= 200 else 5},
                    text=[labels[k] for k in own],
                    textposition=[_side(xy[k]) for k in own],
                    customdata=[number[names[k]] for k in own],
                    hovertemplate="%{text}<br>%{customdata} pairs used<extra></extra>",
                    cliponaxis=False,
                )
            )
    axis = {"visible": False, "range": [-1.6, 1.6]}
    layout = {
        "xaxis": axis,
        "yaxis": {**axis, "scaleanchor": "x", "range": [-1.15, 1.15]},
        "margin": {"l": 8, "r": 8, "t": 8, "b": 8},
    }
    return figure(
        data,
        layout,
        alt=f"Graph of {len(names)} photos with {len(used)} used and {len(odd)} untrusted pairs",
        note=f"{left_out} weaker pairs are left out." if left_out else "",
    )


def _side(xy: np.ndarray) -> str:
    """The side on which a label does not cover the circle."""
    if abs(xy[0]) < 0.3:
        return "top center" if xy[1] > 0 else "bottom center"
    return "middle right" if xy[0] > 0 else "middle left"
