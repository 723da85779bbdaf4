"""The table of photos. To add a column, add a field to `PhotoRow`, and in page.html a heading and a
cell."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.page.embedded import Embedded, embed
from jaxsfm.report.page.pair_states import partners
from jaxsfm.report.run_results import LostPhoto
from jaxsfm.sfm.evaluation import PoseError

MAX_PHOTOS = 60
"""The most rows of the table. How many photos are left out is said below it."""
THUMBNAIL = 96
"""Longer side of a thumbnail, pixels."""


class PhotoRow(NamedTuple):
    """What the table says of one photo."""

    name: str
    thumbnail: Embedded | None
    """None if the photo is gone or has changed since the run."""
    pairs: int
    """The number of pairs with this photo that were used."""
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


def photo_table(run: FinishedRun, names: Sequence[str]) -> PhotoTable:
    """A row for each of the photos: the lost ones first, then those with the largest errors."""
    report = run.report
    lost = {photo.image: photo for photo in report.lost}
    errors = report.evaluation.images if report.evaluation else {}
    seen, used = _seen_points(run), partners(names, report.pairs.each)

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
