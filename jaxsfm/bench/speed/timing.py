"""Metrics, and times that mean something: warmed up, synchronised, interleaved, medians."""

import statistics
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax

REPEAT = 5


class Metric(NamedTuple):
    """One figure."""

    name: str
    value: float
    unit: str
    better: Literal["higher", "lower"]
    tolerance: float | None = None
    """Relative loss against the baseline that the gate lets pass; None: told, not gated. Only
    ratios of one run have one: seconds belong to a machine."""
    spread: float = 0.0
    """Half the distance between least and largest, relative to the value."""


def seconds(*work: Callable[[], Any], repeat: int = REPEAT) -> list[list[float]]:
    """Times of each function, in turns, so that a slow minute meets all of them; the first call of
    each is not counted."""
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
    """Of one function's times."""
    return statistics.median(times)


def ratio(
    name: str,
    above: list[float],
    below: list[float],
    better: Literal["higher", "lower"],
    tolerance: float | None,
) -> Metric:
    """Median of the ratios of times taken in turns."""
    ratios = [a / b for a, b in zip(above, below, strict=True)]
    value = statistics.median(ratios)
    return Metric(name, value, "x", better, tolerance, (max(ratios) - min(ratios)) / 2 / value)
