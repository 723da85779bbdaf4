"""What became of a pair, for matrices, graph and pictures alike."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxsfm.report.page.figures import BLUE, GREEN, GREY, ORANGE


class State(NamedTuple):
    """One of the ends a pair can come to."""

    name: str
    meaning: str
    colour: str


NOT_TRIED, NO_PLANE, NOT_HANDED_ON, NOT_VERIFIED, NOT_TRUSTED, USED = range(6)
STATES = (
    State("not tried", "the pair was not compared", "#00000000"),
    State("no plane", "too few matches, or none on a common plane", "#8a94a344"),
    State("not chosen", "matches, but --best-pairs left it out", GREY),
    State("not verified", "matches, but COLMAP found no common geometry", "#c9b458"),
    State("not trusted", "verified, but stronger pairs contradict it", ORANGE),
    State("used", "verified and handed to the mapper", BLUE),
)
REGISTERED, LOST = GREEN, "#d1435b"
"""Colours of photos with and without a pose."""


def state(row: Mapping[str, Any]) -> int:
    """Index into STATES of a pair's row in report.json."""
    if not row["inliers"]:
        return NO_PLANE
    if not row["handed_on"]:
        return NOT_HANDED_ON
    if not row["colmap_inliers"]:
        return NOT_VERIFIED
    verdict = row["view_graph"]
    return USED if verdict is None or verdict["trusted"] else NOT_TRUSTED


def strength(row: Mapping[str, Any], most: int) -> float:
    """0 .. 1: the view graph's, or without one COLMAP's inliers over the `most` of a pair."""
    verdict = row["view_graph"]
    return verdict["strength"] if verdict else row["colmap_inliers"] / max(most, 1)
