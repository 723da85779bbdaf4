"""Cumulative curves of errors, as in figure 4 of the paper."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxsfm.io.atomic import write_atomic
from jaxsfm.report.plot import COLOURS, encode_figure


def cumulative(errors: Sequence[float], number: int) -> tuple[np.ndarray, np.ndarray]:
    """The cumulative curve of errors as the corners of a step function.

    Args:
      errors: the errors that are known, (n,).
      number: how many things there are, at least n. Those without an error are never reached.

    Returns:
      x (n + 1,): 0, then the errors in ascending order. y (n + 1,): the share of things whose error
      is at most x.
    """
    if number < max(len(errors), 1):
        raise ValueError(f"number must be at least {max(len(errors), 1)}; got {number}")
    share = np.arange(len(errors) + 1) / number
    return np.concatenate([[0.0], np.sort(np.asarray(errors, np.float64))]), share


def write_curves(
    path: Path, panels: Mapping[str, Mapping[str, Sequence[float]]], numbers: Mapping[str, int]
) -> None:
    """Write cumulative curves to a PNG file, with one panel for each kind of error.

    Args:
      panels: by the label of an axis, the errors of each method.
      numbers: how many things each method was tried on.
    """
    figure = Figure(figsize=(6 * len(panels), 4.5), dpi=120, layout="constrained")
    for k, (label, methods) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(1, len(panels), k)
        known = [error for errors in methods.values() for error in errors if error > 0]
        least, largest = (min(known) / 2, max(known) * 2) if known else (0.1, 10.0)
        for (method, errors), colour in zip(methods.items(), COLOURS * len(methods), strict=False):
            x, y = cumulative(errors, numbers[method])
            axes.step([*x, largest], [*y, y[-1]], where="post", color=colour, label=method)
        axes.set_xscale("log")
        axes.set_xlim(least, largest)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel(label)
        axes.set_ylabel("share of night photos")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="upper left")
    write_atomic(path, encode_figure(figure, ".png"))
