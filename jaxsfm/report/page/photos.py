"""The photos in the page: how they are embedded, and their table.

To add a column to the table, add a field to `PhotoRow`, and in page.html a heading and a cell.
"""

import base64
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.io.images import WorkingImage, working_size
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.run_results import LostPhoto
from jaxsfm.sfm.evaluation import PoseError

QUALITY = 72
"""Quality of JPEG, 0 .. 100."""
MAX_PHOTOS = 60
"""The most rows of the table. How many photos are left out is said below it."""
THUMBNAIL = 96
"""Longer side of a thumbnail, pixels."""


class Embedded(NamedTuple):
    """A photo in the page."""

    id: str
    uri: str
    """The photo as JPEG, for the address of an <img>."""
    width: int
    height: int
    scale: np.ndarray
    """Original pixels per pixel of the embedded photo, (x, y)."""

    def place(self, xy: np.ndarray) -> np.ndarray:
        """Original pixels (n, 2) as coordinates of SVG, whose (0, 0) is the top-left corner."""
        return (xy + 0.5) / self.scale


def embed(image: WorkingImage, *, id: str, side: int) -> Embedded:
    """A photo whose longer side is at most `side` pixels."""
    full = (image.rgb.shape[1], image.rgb.shape[0])
    width, height = working_size(full, side)
    small = cv2.resize(image.rgb, (width, height), interpolation=cv2.INTER_AREA)
    # OpenCV encodes photos, see jaxsfm.colmap.
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert ok
    uri = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
    scale = np.asarray(image.scale) * np.asarray(full) / (width, height)
    return Embedded(id, uri, width, height, scale)


class PhotoRow(NamedTuple):
    """What the table says of one photo."""

    name: str
    thumbnail: Embedded | None
    """None if the photo is gone or has changed since the run."""
    pairs: int
    """The number of pairs with this photo that were given to the mapper."""
    observations: int | None
    """The number of points that were seen in it; None if it is not in the model."""
    reprojection_px: float | None
    """Mean over the observations, original pixels."""
    error: PoseError | None
    """The error against the reference poses."""
    lost: LostPhoto | None
    """Why the photo was lost; None if it is in the model."""


class PhotoTable(NamedTuple):
    """The table, and what it leaves out."""

    rows: list[PhotoRow]
    left_out: int
    """The number of photos of the model that have no row."""
    more_lost: list[LostPhoto]
    """Lost photos that have no row."""
    skipped: Mapping[str, str]
    """Why a file could not be used, by name."""


def _seen_points(run: FinishedRun) -> dict[str, tuple[int, float]]:
    """The number of observations of every photo of the model, and their mean reprojection error,
    pixels."""
    if run.model is None:
        return {}
    views, at = run.model.views, run.model.tracks.view
    number = np.bincount(at, minlength=len(views))
    total = np.bincount(at, weights=run.errors, minlength=len(views))
    return {
        view.name: (int(number[k]), float(total[k] / max(number[k], 1)))
        for k, view in enumerate(views)
    }


def _photo_names(report: RunReport) -> list[str]:
    """Every photo that is in a pair, in a model, or lost; sorted."""
    names = {name for row in report.pairs.each for name in row.pair}
    names |= {name for model in report.models for name in model.images}
    return sorted(names | {photo.image for photo in report.lost})


def photo_table(run: FinishedRun) -> PhotoTable:
    """A row for each photo: the lost ones first, then those with the largest errors."""
    report, names = run.report, _photo_names(run.report)
    lost = {photo.image: photo for photo in report.lost}
    errors = report.evaluation.images if report.evaluation else {}
    seen = _seen_points(run)
    used = Counter(name for row in report.pairs.each if row.trusted for name in row.pair)

    def worst_first(name: str) -> tuple[bool, float, float]:
        error = errors[name].position if name in errors else 0.0
        return name not in lost, -error, -seen.get(name, (0, 0.0))[1]

    rows = []
    ordered = sorted(names, key=worst_first)
    for name in ordered[:MAX_PHOTOS]:
        image = run.photos.read(name)
        observations, reprojection_px = seen.get(name, (None, None))
        rows.append(
            PhotoRow(
                name=name,
                thumbnail=image and embed(image, id="", side=THUMBNAIL),
                pairs=used[name],
                observations=observations,
                reprojection_px=reprojection_px,
                error=errors.get(name),
                lost=lost.get(name),
            )
        )
    if len(rows) == len(names):  # all photos have a row: names are easier to find in order
        rows.sort(key=lambda row: (row.lost is None, row.name))
    more = ordered[MAX_PHOTOS:]
    return PhotoTable(
        rows=rows,
        left_out=sum(name not in lost for name in more),
        more_lost=[lost[name] for name in more if name in lost],
        skipped=report.images.skipped,
    )
