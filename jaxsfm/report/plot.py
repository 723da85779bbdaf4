"""Pictures of matches.

They are drawn by matplotlib's Agg canvas and encoded by OpenCV, because Pillow's PNG encoder must
not run in a process that has loaded pycolmap (see jaxsfm.colmap).
"""

from pathlib import Path

import cv2
import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.extras import extra
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import Pixels
from jaxsfm.report.plane_colours import COLOURS, MAX_LINES

with extra("plots", "a picture of matches or curves needs"):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure


def draw_matches(
    rgb0: np.ndarray,
    rgb1: np.ndarray,
    result: PairResult,
    *,
    scale0: np.ndarray,
    scale1: np.ndarray,
) -> Figure:
    """Two images side by side; matches are dots and lines in the colour of their plane.

    Args:
      rgb0, rgb1: the images, uint8 (h, w, 3).
      result: the matches, in original pixels.
      scale0, scale1: original pixels per pixel of an image, (x, y).
    """
    height = max(rgb0.shape[0], rgb1.shape[0])
    width = rgb0.shape[1] + rgb1.shape[1]
    canvas = np.full((height, width, 3), 255, np.uint8)
    canvas[: rgb0.shape[0], : rgb0.shape[1]] = rgb0
    canvas[: rgb1.shape[0], rgb0.shape[1] :] = rgb1
    figure = Figure(figsize=(14, 14 * height / width + 0.5), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(canvas)
    axes.set_axis_off()
    xy0 = Pixels((scale0[0], scale0[1])).from_original(result.keypoints0)
    xy1 = Pixels((scale1[0], scale1[1])).from_original(result.keypoints1) + [rgb0.shape[1], 0]
    for plane in range(len(result.homographies)):
        member = np.flatnonzero(result.plane == plane)
        colour = COLOURS[plane % len(COLOURS)]
        some = member[:: max(1, -(-len(member) // MAX_LINES))]
        axes.add_collection(
            LineCollection(
                list(np.stack([xy0[some], xy1[some]], axis=1)),
                colors=colour,
                linewidths=0.5,
                alpha=0.5,
            )
        )
        for xy in (xy0[member], xy1[member]):
            axes.scatter(xy[:, 0], xy[:, 1], s=2.5, c=colour, linewidths=0)
    axes.set_title(f"{result.num_inliers} matches on {len(result.homographies)} planes")
    return figure


def encode_figure(figure: Figure, suffix: str, *, jpeg_quality: int = 95) -> bytes:
    """A figure as the content of an image file; ValueError for a suffix other than .png or .jpg."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    bgr = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
    is_jpeg = suffix.lower() in (".jpg", ".jpeg")
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if is_jpeg else []
    try:
        ok, data = cv2.imencode(suffix, bgr, options)
    except cv2.error as error:
        raise ValueError(f"suffix must be .png or .jpg; got {suffix!r}") from error
    if not ok:
        raise ValueError(f"the figure cannot be encoded as {suffix}")
    return data.tobytes()


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as .png or .jpg; UserError for another suffix, or if it cannot be written."""
    try:
        path.write_bytes(encode_figure(figure, path.suffix))
    except ValueError as error:
        raise UserError(f"--plot {path}: use .png or .jpg, not {path.suffix!r}") from error
    except OSError as error:
        raise UserError(f"--plot {path}: cannot be written ({error.strerror})") from error
