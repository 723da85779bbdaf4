"""The table of photos. To add a column, add a field to `PhotoRow` and an entry to `COLUMNS`."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.report.finished_run import FinishedModel, FinishedRun
from jaxsfm.report.page.embedded import Embedded, embed
from jaxsfm.report.page.figures import count, figures3
from jaxsfm.report.page.pair_states import USED, state
from jaxsfm.report.run_results import Advice, LostPhoto, Stage
from jaxsfm.sfm.evaluation import PoseError

MAX_PHOTOS = 60
"""The most rows of the table. How many photos are left out is said below it."""
THUMBNAIL = 96
"""Longer side of a thumbnail, pixels."""
OLD_ADVICE: dict[Stage, str] = {
    "pairs": "name pairs with it in the --pairs file, or leave that option out",
    "too few matches": "try --preset robust, or a larger --max-size; is it of the same scene?",
    "no plane": "try --preset robust; the scene may show no surface that both photos share",
    "not connected": "take photos between it and the others, or look at the refused pairs",
    "no pose": "take more photos near it; known --intrinsics help too",
    "not confirmed": "is it of the same place? if it is, take photos between it and the others",
    "other model": "is it of the same place? if it is, take photos between it and the others",
}
"""What may help a photo that was lost at a stage, for reports that hold no advice."""


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
    advice: list[Advice]
    """What may help a lost photo."""


class Column(NamedTuple):
    """A column of numbers."""

    heading: str
    tooltip: str
    cell: Callable[[PhotoRow], str]


def _observations(row: PhotoRow) -> str:
    return "-" if row.observations is None else count(row.observations)


def _reprojection(row: PhotoRow) -> str:
    return "-" if row.reprojection_px is None else f"{row.reprojection_px:.2f}"


COLUMNS = (
    Column(
        "pairs used",
        "Pairs with this photo that were given to the mapper",
        lambda row: str(row.pairs),
    ),
    Column("points seen", "Points of the model that were seen in this photo", _observations),
    Column("error, px", "Mean reprojection error of these points, pixels", _reprojection),
)
ERROR_COLUMNS = (
    Column(
        "position",
        "Distance of the camera from its reference position, units of the reference",
        lambda row: figures3(row.error.position) if row.error else "-",
    ),
    Column(
        "rotation",
        "Angle between the camera and its reference rotation, degrees",
        lambda row: f"{figures3(row.error.rotation_deg)}°" if row.error else "-",
    ),
)
"""The columns that there are only with reference poses."""


class PhotoTable(NamedTuple):
    """The table, and what it leaves out."""

    columns: Sequence[Column]
    rows: list[PhotoRow]
    left_out: int
    """The number of photos of the model that have no row."""
    more_lost: list[LostPhoto]
    """Lost photos that have no row."""
    skipped: Mapping[str, str]
    """Why a file could not be used, by name."""

    @property
    def evaluated(self) -> bool:
        """Whether there are errors against reference poses."""
        return any(column in self.columns for column in ERROR_COLUMNS)


def advice(lost: LostPhoto) -> list[Advice]:
    """What may help a lost photo."""
    if lost.help is None:
        return [Advice(option=None, reason=OLD_ADVICE[lost.stage])]
    return lost.help


def _seen_points(model: FinishedModel | None) -> dict[str, tuple[int, float]]:
    """The number of observations of every photo of the model, and their mean reprojection error,
    pixels."""
    if model is None:
        return {}
    n = len(model.views)
    number = np.bincount(model.tracks.view, minlength=n)
    total = np.bincount(model.tracks.view, weights=model.errors, minlength=n)
    return {
        view.name: (int(number[k]), float(total[k] / max(number[k], 1)))
        for k, view in enumerate(model.views)
    }


def photo_table(run: FinishedRun, names: Sequence[str]) -> PhotoTable:
    """A row for each photo: the lost ones first, then those with the largest errors.

    Args:
      names: all photos of the run.
    """
    report = run.report
    lost = {photo.image: photo for photo in report.lost}
    errors = report.evaluation.images if report.evaluation else {}
    seen = _seen_points(run.model)
    used: dict[str, int] = dict.fromkeys(names, 0)
    for row in report.pairs.each:
        if state(row) == USED:
            for name in row.pair:
                used[name] += 1

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
                advice=advice(lost[name]) if name in lost else [],
            )
        )
    if len(rows) == len(names):  # all photos have a row: names are easier to find in order
        rows.sort(key=lambda row: (row.lost is None, row.name))
    return PhotoTable(
        columns=COLUMNS + ERROR_COLUMNS * bool(errors),
        rows=rows,
        left_out=sum(name not in lost for name in ordered[MAX_PHOTOS:]),
        more_lost=[lost[name] for name in ordered[MAX_PHOTOS:] if name in lost],
        skipped=report.images.skipped,
    )
