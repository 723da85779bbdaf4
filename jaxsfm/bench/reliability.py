"""How far confidences can be relied on: of things with a confidence of 0.8, eight in ten should be
right."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize
from scipy.special import expit

from jaxsfm.io.atomic import write_atomic
from jaxsfm.report.plot import COLOURS, encode_figure

EDGES = (0.0, 0.1, 0.3, 0.7, 0.9, 1.0)
"""The confidences between which things are counted together."""


class Bin(TypedDict):
    """Things with about the same confidence."""

    above: float
    """The lower edge."""
    count: int
    confidence: float
    """Their mean."""
    right: float
    """The share of them that is right."""


def bins(confidences: Sequence[float], right: Sequence[bool]) -> list[Bin]:
    """The reliability diagram; bins without anything are left out."""
    given, truth = np.asarray(confidences, np.float64), np.asarray(right, bool)
    place = np.clip(np.searchsorted(EDGES, given, side="right") - 1, 0, len(EDGES) - 2)
    return [
        {
            "above": EDGES[k],
            "count": int((place == k).sum()),
            "confidence": float(given[place == k].mean()),
            "right": float(truth[place == k].mean()),
        }
        for k in np.unique(place).tolist()
    ]


def calibration_error(found: Sequence[Bin]) -> float:
    """The expected calibration error: the mean of |confidence - right| over all things.

    Source: Naeini, Cooper and Hauskrecht 2015, "Obtaining well calibrated probabilities using
    Bayesian binning".
    """
    total = sum(each["count"] for each in found)
    off = sum(each["count"] * abs(each["confidence"] - each["right"]) for each in found)
    return off / max(total, 1)


def squared_error(confidences: Sequence[float], right: Sequence[bool]) -> float:
    """The mean squared error of confidences (Brier 1950); 0.25 if all are one half."""
    return float(np.square(np.asarray(confidences) - np.asarray(right, np.float64)).mean())


def fitted_curve(evidence: Sequence[float], right: Sequence[bool]) -> tuple[float, float] | None:
    """The curve (`curve_at`) that makes what is right most likely, and its parameters too.

    Few things may be parted by one evidence, and then the most likely curve is a step. So the
    parameters have the weakly informative prior of Gelman et al. 2008, "A weakly informative
    default prior distribution for logistic and other regression models": Cauchy, of scale 2.5 for
    the slope and 10 for the offset, after the logarithms have a standard deviation of one half.

    Returns:
      None if all are right or none is.
    """
    given, truth = _logarithms(evidence), np.asarray(right, bool)
    if truth.all() or not truth.any():
        return None
    middle, width = float(given.mean()), max(2 * float(given.std()), 1e-6)
    scaled = (given - middle) / width

    def unlikelihood(of: np.ndarray) -> float:
        offset, slope = of
        z = offset + slope * scaled
        prior = np.log1p((offset / 10) ** 2) + np.log1p((slope / 2.5) ** 2)
        return float(np.logaddexp(0, np.where(truth, -z, z)).sum() + prior)

    offset, slope = minimize(unlikelihood, [0.0, 1.0], method="Nelder-Mead").x
    return float(np.exp(middle - width * offset / slope)), float(slope / width)


def _logarithms(evidence: Sequence[float]) -> np.ndarray:
    return np.log(np.maximum(np.asarray(evidence, np.float64), 1.0))


def curve_at(evidence: Sequence[float], curve: tuple[float, float]) -> list[float]:
    """Confidences: one half at an evidence, and odds that grow with a power of it.

    Args:
      curve: this evidence, and the power.
    """
    half, power = curve
    return expit(power * (_logarithms(evidence) - np.log(half))).tolist()


def write_diagram(path: Path, methods: Mapping[str, Sequence[Bin]]) -> None:
    """Write a reliability diagram to a PNG file, with a line for each method."""
    figure = Figure(figsize=(5, 5), dpi=120, layout="constrained")
    axes = figure.add_subplot(1, 1, 1)
    axes.plot([0, 1], [0, 1], color="0.7", label="as it should be")
    for (method, found), colour in zip(methods.items(), COLOURS * len(methods), strict=False):
        x, y = ([each[part] for each in found] for part in ("confidence", "right"))
        axes.plot(x, y, "o-", color=colour, label=method)
        for each in found:
            at = (each["confidence"], each["right"])
            axes.annotate(str(each["count"]), at, xytext=(6, -10), textcoords="offset points")
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel("confidence (mean of the pairs)")
    axes.set_ylabel("share of the pairs that are right")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    write_atomic(path, encode_figure(figure, ".png"))
