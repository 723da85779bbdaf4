"""The figures of the page, which plotly draws in the browser: the model, and its errors."""

import html
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.basedatatypes import BaseTraceType

from jaxsfm.io.images import shown_name
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.scene import Scene, ShownCamera, shown_scene

BLUE, ORANGE, GREEN = "#3b82c4", "#e07b39", "#3f9d6b"
"""Colours that are legible on light and dark ground, and that colour-blind readers can tell
apart."""
MAX_POINTS = 40_000
"""The most points that are drawn."""


class Figure(NamedTuple):
    """A figure that plotly draws in the browser."""

    spec: str
    """Data and layout as JSON, with numbers in base64. plotly escapes < and > in it, so that no
    name can end the <script> that holds it."""
    alt: str
    """The figure in a few words, for readers who cannot see it."""
    note: str
    """What the figure leaves out, for the end of its caption."""


def figures(run: FinishedRun) -> Iterator[tuple[str, Figure]]:
    """The figures of the page, each with the name by which page.html places it."""
    if run.model is not None:
        yield "model", model_figure(shown_scene(run))
        yield "reprojection", _reprojection(run.errors)
    if evaluation := run.report.evaluation:
        total, errors = evaluation.reference_images, evaluation.images.values()
        positions, rotations = [e.position for e in errors], [e.rotation_deg for e in errors]
        unit = "units of the reference"
        yield "positions", _cumulative("position", unit, BLUE, positions, total)
        yield "rotations", _cumulative("rotation", "degrees", GREEN, rotations, total)


def _figure(
    data: Sequence[BaseTraceType], layout: Mapping[str, object], *, alt: str, note: str = ""
) -> Figure:
    """A figure. The page gives it the colours of ground, text and grid."""
    base = {
        "template": go.layout.Template(),
        "margin": {"l": 60, "r": 16, "t": 12, "b": 50},
    }
    made = go.Figure(data=list(data), layout={**base, **layout})
    spec = made.to_json()
    assert spec is not None
    return Figure(spec, alt, note)


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
            # The texts of plotly may hold a few HTML tags.
            text=[html.escape(shown_name(c.name)) for c in cameras],
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
    return _figure(data, layout, alt=alt, note=" ".join(notes))


def _axis(title: str, **more: object) -> dict[str, object]:
    return {"title": {"text": title}, "automargin": True, **more}


def _reprojection(errors: np.ndarray) -> Figure:
    """A histogram of the reprojection errors of all observations, pixels."""
    errors = errors[np.isfinite(errors)]
    top = float(max(np.percentile(errors, 99), 0.1)) if len(errors) else 1.0
    counts, edges = np.histogram(np.minimum(errors, top), bins=50, range=(0, top))
    bars = go.Bar(
        x=(edges[:-1] + edges[1:]).astype(np.float32) / 2,
        y=counts,
        marker={"color": BLUE},
        hovertemplate="%{x:.2f} px: %{y}<extra></extra>",
    )
    layout = {"xaxis": _axis("pixels"), "yaxis": _axis("observations"), "bargap": 0.05}
    return _figure([bars], layout, alt=f"Histogram of {len(errors)} reprojection errors")


def _cumulative(what: str, unit: str, colour: str, values: list[float], total: int) -> Figure:
    """The cumulative curve of the errors of cameras.

    Args:
      what: the kind of error.
      values: an error for each camera of the model that the reference has.
      total: the number of all photos of the reference.
    """
    errors = np.sort(values)
    share = 100 * np.arange(1, len(errors) + 1) / total
    curve = go.Scatter(
        x=np.r_[0, errors].astype(np.float32),
        y=np.r_[0, share].astype(np.float32),
        mode="lines+markers" if len(errors) <= 100 else "lines",
        line={"shape": "hv", "color": colour, "width": 2},
        hovertemplate="%{y:.0f} % within %{x:.4g}<extra></extra>",
    )
    layout = {
        "xaxis": _axis(unit, rangemode="tozero", exponentformat="none"),
        "yaxis": _axis("photos, %", range=[0, 104]),
    }
    return _figure([curve], layout, alt=f"Cumulative curve of {len(errors)} {what} errors")
