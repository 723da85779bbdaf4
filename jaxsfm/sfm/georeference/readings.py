"""Other ways to read measured positions, and whether the photos say that one of them is meant.

Files of positions are often written with exchanged columns, a sign that is missing, or another unit
than they say. Each such mistake is tried: the positions are read as they would be without it, and
the model is moved onto them. If they fit the model far better than the positions as the file gives
them, that was meant.

Mistakes that mirror all positions cannot be told from the residuals if the positions lie in a
plane. The cameras hang upside down then (`upward`). This is a remark and no contradiction, because
the heights of some surveys count downwards.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

from jaxsfm.errors import UserError
from jaxsfm.io.orientation import QUARTERS, UPRIGHT, stored_axes
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.georeference.coordinate_system import CoordinateSystem
from jaxsfm.sfm.georeference.robust_similarity import (
    CERTAIN,
    EXACT,
    Anchors,
    robust_similarity,
)

FOOT = 0.3048
LOCAL_DEGREES = 0.01
"""Coordinates without a system that change by less than this, and less than their heights, are
degrees: it is a kilometre in degrees, and a centimetre in metres."""
LEAST_TOLD = 4
"""Three positions fit a model in many wrong ways; from four on their residuals can tell."""
AGREED = 0.8
"""The length of the mean of the cameras' upward directions, unit vectors, from which on it says
where up is. It is 0.8 if each is 37 degrees from the mean."""
STANDING = 0.5
"""Cameras that are pitched by less than 60 degrees have so much of their upward direction along the
vertical. Of cameras that look straight down it says nothing about the vertical."""


class Reading(NamedTuple):
    """A way to read the numbers of a file."""

    words: str
    """What would be the case, in words that follow "they would fit if"."""
    read: Callable[[np.ndarray], np.ndarray]
    """Positions float64 (n, 3) as they are meant, from those of the file."""
    height: float = 1.0
    """By how much heights are larger than the file's. Errors are compared in the file's unit:
    smaller heights also have smaller errors."""


def _times(x: float, y: float, z: float) -> Callable[[np.ndarray], np.ndarray]:
    factors = np.asarray([x, y, z])
    return lambda xyz: xyz * factors


def _exchanged(xyz: np.ndarray) -> np.ndarray:
    return xyz[:, [1, 0, 2]]


def other_readings(system: CoordinateSystem) -> list[Reading]:
    """The readings that are tried, those of the more usual mistakes first."""
    if system.kind == "geographic":
        return [
            Reading("latitude and longitude were exchanged", _exchanged),
            Reading("the longitude had the other sign", _times(-1, 1, 1)),
            Reading("the latitude had the other sign", _times(1, -1, 1)),
            Reading("the heights were feet", _times(1, 1, FOOT), FOOT),
        ]
    unit = system.metres[2]
    heights = (
        Reading("the heights were feet", _times(1, 1, FOOT), FOOT)
        if unit == 1
        else Reading("the heights were metres", _times(1, 1, 1 / unit), 1 / unit)
    )
    return [
        Reading("x and y were exchanged", _exchanged),
        Reading("the heights had the other sign", _times(1, 1, -1)),
        heights,
    ]


class Fit(NamedTuple):
    """A model moved onto one reading of the positions."""

    anchors: Anchors
    similarity: Similarity
    height: float = 1.0
    """`Reading.height`."""

    def error(self, rows: np.ndarray) -> float:
        """The mean squared error of a fit to some of the positions, in the file's unit of height;
        at least what rounding makes of it."""
        part = self.anchors.select(rows)
        residuals = part.residuals(part.fit()) / [1, 1, self.height]
        spread = np.linalg.norm(part.target - part.target.mean(0), axis=1).max()
        floor = (EXACT * spread / part.deviation.min()) ** 2
        return max(float(((residuals / part.deviation[:, None]) ** 2).sum(1).mean()), floor)


def misread(fit: Fit, raw: np.ndarray, system: CoordinateSystem) -> str | None:
    """What was probably meant by positions that contradict the photos; None if they do not.

    Args:
      fit: to the positions as the file gives them.
      raw: float64 (n, 3), the positions in the file's own numbers.
    """
    if len(raw) < LEAST_TOLD:
        return None
    best, meant = np.inf, None
    for reading in other_readings(system):
        found = _fit(fit.anchors, reading, raw, system)
        if found is None:
            continue
        other, rows = found
        freedom = 3 * int(rows.sum()) - 7
        limit = float(stats.f.ppf(CERTAIN, freedom, freedom))
        given, without = fit.error(rows), other.error(rows)
        if given > limit * without and without < best / 2:
            best = without
            times = np.sqrt(given / without)
            meant = f"they would fit {times:.0f} times as well if {reading.words}"
    return meant


def _fit(
    given: Anchors, reading: Reading, raw: np.ndarray, system: CoordinateSystem
) -> tuple[Fit, np.ndarray] | None:
    """The model moved onto another reading, and bool (n,) which positions agree with the move; None
    if no place has such coordinates."""
    xyz = reading.read(raw)
    if system.kind == "geographic" and (np.abs(xyz[:, :2]) > [180, 90]).any():
        return None
    try:
        target = system.into(system.frame(xyz), xyz)
    except UserError:
        return None
    anchors = given._replace(target=target)
    similarity, used = robust_similarity(anchors)
    if not similarity.scale > 0 or int(used.sum()) < LEAST_TOLD:
        return None
    return Fit(anchors, similarity, reading.height), used


def misnamed(raw: np.ndarray, system: CoordinateSystem) -> str | None:
    """What is wrong with positions that cannot be in their system, in words; None if they can be.

    Positions outside the region of their system are not wrong by themselves: projections are used
    beyond it, too. They are wrong if they lie in it after a usual mistake is undone.

    Args:
      raw: float64 (n, 3), n >= 1, in the file's own numbers.
    """
    low, high = raw[:, :2].min(0), raw[:, :2].max(0)
    angles = (np.abs(raw[:, :2]) <= 180).all() and (np.abs(raw[:, :2]).min(0) <= 90).any()
    wide = float((high - low).max())
    if system.kind == "local":
        deep = float(np.ptp(raw[:, 2]))
        if not (len(raw) >= LEAST_TOLD and angles and 0 < wide < LOCAL_DEGREES and deep > wide):
            return None
        return (
            f"x and y change by {wide:.2g} in all, and z by {deep:.2g}; if x and y are degrees, "
            "call the columns lon and lat"
        )
    if system.kind != "projected" or system.covers(raw):
        return None
    if angles and wide < 1:  # one degree is 111 km, and a unit of a projection at most a metre
        order = "latitude and longitude" if system.around(raw[:, [1, 0, 2]]) else "degrees"
        return (
            f"the coordinates ({low[0]:.6g}, {low[1]:.6g}) to ({high[0]:.6g}, {high[1]:.6g}) are "
            f"{order}, and not lengths in {system.name}"
            + (" (in degrees)" if order != "degrees" else "")
            + "; name EPSG:4326, and write the longitude first"
        )
    if system.covers(_exchanged(raw)):
        return (
            f"the position ({raw[0, 0]:.12g}, {raw[0, 1]:.12g}) lies outside the region of "
            f"{system.name}, and would lie in it if x and y were exchanged: the easting comes first"
        )
    return None


def is_upside_down(
    rotations: Mapping[str, np.ndarray], turned: Mapping[str, int], similarity: Similarity
) -> bool:
    """Whether the cameras of a model hang upside down after its move; False if it is not certain.

    Args:
      rotations, turned: as in `upward`.
    """
    up = upward(rotations, turned)
    return up is not None and float((similarity.rotation @ up)[2]) < -STANDING


def upward(rotations: Mapping[str, np.ndarray], turned: Mapping[str, int]) -> np.ndarray | None:
    """The direction that is up in most photos of a model, float64 (3,); None if they do not agree.

    People and drones hold cameras upright, or pitched up or down.

    Args:
      rotations: float64 (3, 3), world to camera, by the name of the photo.
      turned: how photos are turned that are not stored upright, by name (`jaxsfm.io.orientation`).
    """
    up = []
    for name, rotation in sorted(rotations.items()):
        code = turned.get(name, UPRIGHT)
        if code in QUARTERS:  # mirrored photos have no axes
            up.append(rotation.T @ stored_axes(code) @ [0.0, -1.0, 0.0])
    mean = np.mean(up, axis=0) if up else np.zeros(3)
    length = float(np.linalg.norm(mean))
    return mean / length if length >= AGREED else None
