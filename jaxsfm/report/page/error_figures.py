"""How accurate the model is: by its reprojection errors, and against reference poses."""

import numpy as np
import plotly.graph_objects as go

from jaxsfm.report.finished_run import FinishedModel
from jaxsfm.report.page.figures import BLUE, GREEN, Figure, figure
from jaxsfm.report.run_results import EvaluationReport

LONGEST_TRACK = 15
"""Longer tracks share the last bar."""


def _axis(title: str, **more: object) -> dict[str, object]:
    return {"title": {"text": title}, "automargin": True, **more}


def reprojection_figure(model: FinishedModel) -> Figure:
    """A histogram of the reprojection errors of all observations."""
    errors = model.errors[np.isfinite(model.errors)]
    top = float(max(np.percentile(errors, 99), 0.1)) if len(errors) else 1.0
    counts, edges = np.histogram(np.minimum(errors, top), bins=50, range=(0, top))
    return figure(
        "reprojection",
        "Reprojection errors",
        "A reprojection error is the distance between the place where a point was seen in a photo "
        "and the place where the model projects it. In a good model most errors are near zero. The "
        "last bar holds the largest 1 %.",
        alt=f"Histogram of {len(errors)} reprojection errors",
        data=[
            go.Bar(
                x=(edges[:-1] + edges[1:]).astype(np.float32) / 2,
                y=counts,
                marker={"color": BLUE},
                hovertemplate="%{x:.2f} px: %{y}<extra></extra>",
            )
        ],
        layout={"xaxis": _axis("pixels"), "yaxis": _axis("observations"), "bargap": 0.05},
    )


def track_figure(model: FinishedModel) -> Figure:
    """A bar chart of the number of photos in which a point was seen."""
    lengths = np.bincount(model.tracks.point, minlength=len(model.tracks.points))
    counts = np.bincount(np.minimum(lengths, LONGEST_TRACK), minlength=3)[2:]
    labels = [str(k) for k in range(2, 2 + len(counts))]
    if len(labels) == LONGEST_TRACK - 1:
        labels[-1] += "+"
    return figure(
        "tracks",
        "How many photos see each point",
        "A point that was seen in many photos is well determined. Points that were seen in two "
        "photos only are the least certain.",
        alt=f"Bar chart of the track lengths of {len(lengths)} points",
        data=[
            go.Bar(
                x=labels,
                y=counts,
                marker={"color": GREEN},
                hovertemplate="seen in %{x} photos: %{y} points<extra></extra>",
            )
        ],
        layout={
            "xaxis": _axis("photos", type="category"),
            "yaxis": _axis("points"),
            "bargap": 0.15,
        },
    )


def cumulative_figures(evaluation: EvaluationReport) -> list[Figure]:
    """Cumulative curves of the position errors and of the rotation errors."""
    total = evaluation.reference_images
    figures = []
    images = evaluation.images.values()
    positions, rotations = [e.position for e in images], [e.rotation_deg for e in images]
    for id, what, values, unit, colour in (
        ("positions", "position", positions, "units of the reference", BLUE),
        ("rotations", "rotation", rotations, "degrees", GREEN),
    ):
        errors = np.sort(values)
        share = 100 * np.arange(1, len(errors) + 1) / total
        figures.append(
            figure(
                id,
                f"{what.title()} errors",
                f"The curve shows the share of the reference's {total} photos whose {what} is off "
                "by no more than the value on the axis. A good curve rises early and ends at "
                "100 %.",
                alt=f"Cumulative curve of {len(errors)} {what} errors",
                data=[
                    go.Scatter(
                        x=np.r_[0, errors].astype(np.float32),
                        y=np.r_[0, share].astype(np.float32),
                        mode="lines+markers" if len(errors) <= 100 else "lines",
                        line={"shape": "hv", "color": colour, "width": 2},
                        hovertemplate="%{y:.0f} % within %{x:.4g}<extra></extra>",
                    )
                ],
                layout={
                    "xaxis": _axis(unit, rangemode="tozero", exponentformat="none"),
                    "yaxis": _axis("photos, %", range=[0, 104]),
                },
            )
        )
    return figures
