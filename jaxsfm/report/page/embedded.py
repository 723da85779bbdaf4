"""Photos that are embedded in the page."""

import base64
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.io.images import WorkingImage, working_size

QUALITY = 72
"""Quality of JPEG, 0 .. 100."""


class Embedded(NamedTuple):
    """A photo in the page."""

    id: str
    uri: str
    width: int
    height: int
    scale: np.ndarray
    """Original pixels per pixel of the embedded photo, (x, y)."""

    def place(self, xy: np.ndarray) -> np.ndarray:
        """Original pixels (n, 2) as coordinates of SVG, whose (0, 0) is the top-left corner."""
        return (xy + 0.5) / self.scale


def data_uri(rgb: np.ndarray, suffix: str) -> str:
    """Colours uint8 (h, w, 3) as the address of an <img>.

    Args:
      suffix: .jpg or .png. OpenCV encodes both, see jaxsfm.colmap.
    """
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if suffix == ".jpg" else []
    ok, data = cv2.imencode(suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    assert ok
    kind = "jpeg" if suffix == ".jpg" else "png"
    return f"data:image/{kind};base64," + base64.b64encode(data.tobytes()).decode()


def embed(image: WorkingImage, *, id: str, side: int) -> Embedded:
    """A photo as JPEG whose longer side is at most `side` pixels."""
    rgb = image.rgb
    full = (rgb.shape[1], rgb.shape[0])
    width, height = working_size(full, side)
    small = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    scale = np.asarray(image.scale) * np.asarray(full) / (width, height)
    return Embedded(id, data_uri(small, ".jpg"), width, height, scale)
