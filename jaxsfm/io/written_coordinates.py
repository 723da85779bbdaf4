"""Coordinates with the decimals that a file writes them with: which are equal but for rounding."""

from collections.abc import Iterable
from typing import NamedTuple

ON_EARTH = 1e-9
"""Coordinates that differ by this factor are the same. On a sphere of the Earth's size it is 6 mm,
whether degrees or metres count it, and receivers with corrections measure a centimetre."""
NEIGHBOURS = 1e-3
"""Control points that are nearer to each other than this part of the whole area would say twice the
same about where it is. So lines that differ by less, and only by rounding, mean one point."""


class Written(NamedTuple):
    """A finite number as a file writes it."""

    value: float
    decimals: float
    """How many decimals it has: 2 for 12.50, 4 for 1.25e-2, 0 for 3e5."""

    def equals(self, other: "Written") -> bool:
        """Whether both are one number, up to the rounding of the one with fewer decimals.

        12.346 and 12.3456 are, 12.3460 and 12.3456 are not. Neighbours that no measurement tells
        apart (`ON_EARTH`) are, too.
        """
        tolerance = ON_EARTH * abs(self.value)
        if self.decimals != other.decimals:
            # A half may be rounded up or down, and no binary fraction is exactly a half.
            tolerance += 10.0 ** -min(self.decimals, other.decimals) / 2
        return abs(self.value - other.value) <= tolerance

    def finer(self, other: "Written") -> "Written":
        """The one with more decimals; this one if both have as many."""
        return other if other.decimals > self.decimals else self


class Coordinates(NamedTuple):
    """x, y and z as they are written."""

    x: Written
    y: Written
    z: Written | None

    @property
    def values(self) -> tuple[float, float, float | None]:
        """The numbers."""
        return self.x.value, self.y.value, None if self.z is None else self.z.value

    def equal(self, other: "Coordinates") -> bool:
        """Whether they differ by nothing but rounding. No height equals no height alone."""
        both = self.z is not None and other.z is not None and self.z.equals(other.z)
        same_height = both or (self.z is None and other.z is None)
        return self.x.equals(other.x) and self.y.equals(other.y) and same_height

    def rounds(self, other: "Coordinates", most: tuple[float, float, float]) -> bool:
        """Whether they are `equal` and differ by no more than this along x, y and z."""
        pairs = zip(self.values, other.values, most, strict=True)
        close = (a is None or b is None or abs(a - b) <= d for a, b, d in pairs)
        return self.equal(other) and all(close)

    def finest(self, other: "Coordinates") -> "Coordinates":
        """Of each coordinate, the one with more decimals (`equal` coordinates)."""
        z = self.z if self.z is None or other.z is None else self.z.finer(other.z)
        return Coordinates(self.x.finer(other.x), self.y.finer(other.y), z)


def written(text: str) -> Written:
    """The number in a text. Raises ValueError if there is none."""
    mantissa, _, exponent = text.strip().lower().replace("_", "").partition("e")
    value = float(text)
    return Written(value, max(0.0, len(mantissa.partition(".")[2]) - float(exponent or 0)))


def neighbourhood(every: Iterable[Coordinates]) -> tuple[float, float, float]:
    """How far apart, along x, y and z, two of these may be and still mean one point."""
    x, y, z = zip(*(each.values for each in every), strict=True)
    level = NEIGHBOURS * max(max(x) - min(x), max(y) - min(y))
    heights = [each for each in z if each is not None] or [0.0]
    return level, level, NEIGHBOURS * (max(heights) - min(heights))
