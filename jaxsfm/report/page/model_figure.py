"""The 3-D model, which the reader can turn with the mouse."""

import numpy as np
import plotly.graph_objects as go
from plotly.basedatatypes import BaseTraceType

from jaxsfm.report.page.figures import BLUE, ORANGE, Figure, figure, text
from jaxsfm.report.scene import Scene, ShownCamera

MAX_POINTS = 40_000
"""The most points that are drawn."""


def _hex(colours: np.ndarray) -> list[str]:
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours.tolist()]


def _coordinates(points: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))


def _cameras(
    cameras: list[ShownCamera], depth: float, name: str, colour: str
) -> list[BaseTraceType]:
    """The frusta as one line with gaps, and the centres, which show a name under the mouse."""
    gap = np.full((1, 3), np.nan)
    lines = np.concatenate([p for c in cameras for p in (c.frustum(depth), gap)])
    return [
        go.Scatter3d(
            **_coordinates(lines),
            mode="lines",
            name=name,
            legendgroup=name,
            line={"color": colour, "width": 3},
            hoverinfo="skip",
        ),
        go.Scatter3d(
            **_coordinates(np.asarray([c.pose.centre for c in cameras])),
            mode="markers",
            name=name,
            legendgroup=name,
            showlegend=False,
            marker={"color": colour, "size": 3},
            text=[text(c.name) for c in cameras],
            hovertemplate="%{text}<extra></extra>",
        ),
    ]


def model_figure(scene: Scene) -> Figure:
    """The points in their colours, the cameras, and those of the reference if there is one."""
    n = len(scene.points)
    some = np.sort(np.random.default_rng(0).permutation(n)[:MAX_POINTS])
    data: list[BaseTraceType] = [
        go.Scatter3d(
            **_coordinates(scene.points[some]),
            mode="markers",
            name="points",
            # Squares are two triangles each: circles take three times as long to draw.
            marker={"size": 1.6, "symbol": "square", "color": _hex(scene.colours[some])},
            hoverinfo="skip",
        ),
        *_cameras(scene.cameras, scene.frustum_depth, "cameras", BLUE),
    ]
    if scene.reference:
        data += _cameras(scene.reference, 1.3 * scene.frustum_depth, "reference", ORANGE)
    notes = []
    if n > MAX_POINTS:
        notes.append(f"{MAX_POINTS} of {n} points are drawn, taken at random.")
    if scene.far:
        notes.append(f"{scene.far} points far away from the others are left out.")
    axis = {"showbackground": False, "title": {"text": ""}, "nticks": 6}
    eye = 1.55 * scene.behind()  # in the units of plotly
    layout = {
        "scene": {
            "aspectmode": "data",
            "dragmode": "orbit",
            "camera": {
                "eye": dict(zip("xyz", eye.tolist(), strict=True)),
                "up": {"x": 0, "y": 0, "z": 1},
            },
            **dict.fromkeys(("xaxis", "yaxis", "zaxis"), axis),
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"itemsizing": "constant", "orientation": "h", "x": 0, "y": 1, "yanchor": "top"},
    }
    alt = f"3-D model with {len(some)} points and {len(scene.cameras)} cameras"
    return figure(data, layout, alt=alt, note=" ".join(notes))
