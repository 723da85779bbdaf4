"""Photos that are altered in a known way: cut, reduced, turned by quarters, and at a synthetic
night."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.bench.inputs import usable_image
from jaxsfm.bench.night import synthetic_night
from jaxsfm.bench.synthetic import write_photo
from jaxsfm.io.images import ImageFile


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alteration:
    """What is done to a photo, in this order."""

    corner: tuple[float, float] = (0.0, 0.0)
    """Where the part that is kept begins, as shares of width and height."""
    side: float = 1.0
    """The sides of this part, as a share of those of the photo."""
    scale: float = 1.0
    """The size after the photo is reduced, as a share of the size before."""
    severity: float = 0.0
    """Of the synthetic night (`jaxsfm.bench.night`); 0: it stays day."""
    quarters: int = 0
    """Quarter turns to the left."""

    def __str__(self) -> str:
        parts = [
            f"cut to {self.side:.2f}" if self.side < 1 else "",
            f"reduced to {self.scale:.2f}" if self.scale < 1 else "",
            f"night {self.severity:.2f}" if self.severity else "",
            f"turned {90 * (self.quarters % 4)}" if self.quarters % 4 else "",
        ]
        return " ".join(filter(None, parts)) or "as it is"


class Altered(NamedTuple):
    """An altered photo."""

    rgb: np.ndarray
    """uint8 (h, w, 3)."""
    to_original: np.ndarray
    """float64 (3, 3), affine: from its pixels to those of the photo as it was."""

    @property
    def pixel(self) -> float:
        """The side of its pixels, pixels of the photo as it was."""
        return float(np.sqrt(abs(np.linalg.det(self.to_original[:2, :2]))))

    def written(self, path: Path) -> ImageFile:
        """The photo in a file, which is written."""
        write_photo(path, self.rgb)
        return usable_image(path)


def alter(rgb: np.ndarray, alteration: Alteration, *, seed: int = 0) -> Altered:
    """Alter a photo.

    Args:
      rgb: uint8 (h, w, 3).
      seed: of the lamps and the noise of a night.

    Raises:
      ValueError: the part that is kept is not inside the photo, or the photo would be enlarged.
    """
    kept = [*alteration.corner, *(c + alteration.side for c in alteration.corner)]
    if not (min(kept) >= 0 and max(kept) <= 1 and 0 < alteration.side):
        raise ValueError(f"the kept part must be inside the photo; got {alteration}")
    if not 0 < alteration.scale <= 1:
        raise ValueError(f"scale must be above 0 and at most 1; got {alteration.scale}")
    sides = np.asarray([rgb.shape[1], rgb.shape[0]])
    first = np.round(np.asarray(alteration.corner) * sides).astype(int)
    part = np.maximum(np.round(alteration.side * sides).astype(int), 1)
    part = np.minimum(part, sides - first)
    image = rgb[first[1] : first[1] + part[1], first[0] : first[0] + part[0]]
    reduced = np.maximum(np.round(alteration.scale * part).astype(int), 1)
    if (reduced != part).any():
        image = cv2.resize(image, reduced.tolist(), interpolation=cv2.INTER_AREA)
    if alteration.severity:
        image = synthetic_night(image, severity=alteration.severity, seed=seed)
    zoom = part / reduced
    # Both corners of the images, (-0.5, -0.5), are the same point.
    to_original = np.diag([*zoom, 1.0])
    to_original[:2, 2] = (zoom - 1) / 2 + first
    for _ in range(alteration.quarters % 4):
        # After a quarter turn to the left, pixel (x, y) shows what was at (width - 1 - y, x).
        width = image.shape[1]
        to_original = to_original @ np.asarray([[0, -1, width - 1], [1, 0, 0], [0, 0, 1.0]])
        image = np.rot90(image)
    return Altered(np.ascontiguousarray(image), to_original)
