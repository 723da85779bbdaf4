"""Measuring times: functions are warmed up, synchronised and run in turns; medians are compared."""

import statistics
import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

REPEAT = 5


class Metric(NamedTuple):
    """One figure of the table."""

    name: str
    value: float
    unit: str
    better: Literal["higher", "lower"]
    tolerance: float | None = None
    """How much worse than the baseline, relative to it, the figure may be; None if it is not
    compared. Only ratios within one run are compared, because seconds depend on the machine."""
    spread: float = 0.0
    """Half the difference between the largest and the smallest value, relative to the figure."""


def seconds(*work: Callable[[], object], repeat: int = REPEAT) -> list[list[float]]:
    """The times of each function.

    The functions run in turns, so that a slow minute of the machine affects all of them. The first
    call of each function compiles and is not counted.
    """
    for function in work:
        jax.block_until_ready(function())
    times: list[list[float]] = [[] for _ in work]
    for _ in range(repeat):
        for function, own in zip(work, times, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(function())
            own.append(time.perf_counter() - start)
    return times


def median(times: list[float]) -> float:
    """The median of the times of one function."""
    return statistics.median(times)


def ratio(
    name: str,
    above: list[float],
    below: list[float],
    better: Literal["higher", "lower"],
    tolerance: float | None,
) -> Metric:
    """The median ratio of two functions' times, compared turn by turn."""
    ratios = [a / b for a, b in zip(above, below, strict=True)]
    value = statistics.median(ratios)
    return Metric(name, value, "x", better, tolerance, (max(ratios) - min(ratios)) / 2 / value)
