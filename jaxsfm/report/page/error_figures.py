"""How accurate the model is: by its reprojection errors, and against reference poses."""

import numpy as np
import plotly.graph_objects as go

from jaxsfm.colmap.tracks import Tracks
from jaxsfm.report.page.figures import BLUE, GREEN, Figure, figure

LONGEST_TRACK = 15
"""Longer tracks share the last bar."""


def _axis(title: str, **more: object) -> dict[str, object]:
    return {"title": {"text": title}, "automargin": True, **more}


def reprojection_figure(errors: np.ndarray) -> Figure:
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
    return figure([bars], layout, alt=f"Histogram of {len(errors)} reprojection errors")


def track_figure(tracks: Tracks) -> Figure:
    """A bar chart of the number of photos in which a point was seen."""
    lengths = tracks.num_observations()
    counts = np.bincount(np.minimum(lengths, LONGEST_TRACK), minlength=3)[2:]
    labels = [str(k) for k in range(2, 2 + len(counts))]
    if len(labels) == LONGEST_TRACK - 1:
        labels[-1] += "+"
    bars = go.Bar(
        x=labels,
        y=counts,
        marker={"color": GREEN},
        hovertemplate="seen in %{x} photos: %{y} points<extra></extra>",
    )
    axes = {"xaxis": _axis("photos", type="category"), "yaxis": _axis("points")}
    alt = f"Bar chart of the track lengths of {len(lengths)} points"
    return figure([bars], {**axes, "bargap": 0.15}, alt=alt)


def cumulative_figure(what: str, unit: str, colour: str, values: list[float], total: int) -> Figure:
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
    return figure([curve], layout, alt=f"Cumulative curve of {len(errors)} {what} errors")
