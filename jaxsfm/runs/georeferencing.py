"""What a run is moved onto: the value of `--georeference`, read and checked before the work."""

import dataclasses
import logging
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.exif_gps import read_gps
from jaxsfm.io.images import ImageFile, named, shown_name
from jaxsfm.io.position_tables import (
    OPTION,
    ControlPoint,
    PositionTable,
    read_position_table,
)
from jaxsfm.sfm.georeference.coordinate_system import GPS, CoordinateSystem, coordinate_system
from jaxsfm.sfm.georeference.georeference import MeasuredPositions
from jaxsfm.sfm.georeference.readings import misnamed
from jaxsfm.sfm.georeference.robust_similarity import LEAST

logger = logging.getLogger("jaxsfm")


def measured_positions(
    choice: str, images: Sequence[ImageFile], views: Sequence[ImageFile] = ()
) -> MeasuredPositions | None:
    """What `--georeference` asks to move the models onto; None if they stay as they are.

    Args:
      choice: auto, off, gps, or a file of positions.
      images: the usable photos.
      views: those of panoramas among the photos, which a file may name too.

    Raises:
      UserError: the file cannot be used, or `gps` is asked for and too few photos have a position.
    """
    if choice == "off":
        return None
    if choice in ("auto", "gps"):
        found = read_gps(images)
        full = sum(at.full for at in found.values())
        if choice == "gps" and full < LEAST:
            raise UserError(
                f"{OPTION} gps: {full} photos have a GPS position with an altitude; at least "
                f"{LEAST} are needed"
            )
        if not found:
            return None
        return MeasuredPositions(
            source="gps", file=None, system=GPS, positions=found, sure=choice == "auto"
        )
    path = Path(choice)
    if not path.exists():
        raise UserError(f"{OPTION} {shown_name(choice)}: no such file, and not auto, off or gps")
    table = read_position_table(path)
    system = coordinate_system(table.system, f"{OPTION} {path}")
    _check_angles(table, system, path)
    every = [*table.positions.values(), *(point.position for point in table.points)]
    given = np.asarray([(at.x, at.y, at.z or 0.0) for at in every])
    if (meant := misnamed(given, system)) is not None:
        raise UserError(f"{OPTION} {path}: {meant}")
    system.check(given)
    names = _MatchedNames(images, views)
    if table.points:
        points = _points_of(table, names, {image.name: image for image in (*images, *views)}, path)
        return MeasuredPositions(
            source="control points",
            file=str(path),
            system=system,
            positions={},
            points=points,
            sure=False,
        )
    known = {name: names.photo(name) for name in table.positions}
    positions = {photo: table.positions[name] for name, photo in known.items() if photo is not None}
    _report_strangers([name for name, photo in known.items() if photo is None], path)
    full = sum(at.full for at in positions.values())
    if full < LEAST:
        raise UserError(
            f"{OPTION} {path}: {full} photos of the folder have a position with a height in it; at "
            f"least {LEAST} are needed" + _example(table.positions, images)
        )
    return MeasuredPositions(
        source="positions", file=str(path), system=system, positions=positions, sure=False
    )


class _MatchedNames:
    """Photos by the names that files of positions use: with the folder or without it. Views of
    panoramas have their folder, as without it they have the name of the panorama."""

    def __init__(self, images: Iterable[ImageFile], views: Iterable[ImageFile]) -> None:
        names = sorted({image.name for image in images})
        self._names = {*names, *(view.name for view in views)}
        self._short: dict[str, list[str]] = {}
        for name in names:
            self._short.setdefault(Path(name).name.lower(), []).append(name)

    def photo(self, name: str) -> str | None:
        """The photo with this name; None if there is none, or several folders have one."""
        if name in self._names:
            return name
        found = self._short.get(name.replace("\\", "/").rpartition("/")[2].lower(), [])
        return found[0] if len(found) == 1 else None


def _points_of(
    table: PositionTable, names: _MatchedNames, images: dict[str, ImageFile], path: Path
) -> list[ControlPoint]:
    """The control points with a height, with the measurements in photos of the run."""
    points, strangers = [], []
    for point in table.points:
        seen = []
        for each in point.seen:
            photo = names.photo(each.image)
            if photo is None:
                strangers.append(each.image)
                continue
            width, height = images[photo].size
            if not (-0.5 <= each.x <= width - 0.5 and -0.5 <= each.y <= height - 0.5):
                raise UserError(
                    f"{OPTION} {path}, line {each.line}: the pixel ({each.x:g}, {each.y:g}) lies "
                    f"outside {shown_name(photo)}, which has {width} x {height} pixels"
                )
            seen.append(each._replace(image=photo))
        if not point.position.full:
            logger.warning("%s: the point %s has no height, so it is not used", path, point.name)
        elif len(seen) >= 2:
            points.append(dataclasses.replace(point, seen=seen))
    _report_strangers(sorted(set(strangers)), path)
    if len(points) < LEAST:
        raise UserError(
            f"{OPTION} {path}: {len(points)} control points have a height and are measured in two "
            f"photos of the folder or more; at least {LEAST} are needed"
            + _example(
                [each.image for point in table.points for each in point.seen], images.values()
            )
        )
    return points


def _check_angles(table: PositionTable, system: CoordinateSystem, path: Path) -> None:
    """UserError if longitude and latitude are not in their ranges, or in the wrong order."""
    if system.kind != "geographic":
        return
    given = {point.name: point.position for point in table.points} | table.positions
    for name, at in given.items():
        if abs(at.x) > 180 or abs(at.y) > 90:
            raise UserError(
                f"{OPTION} {path}: the longitude of {shown_name(name)} must lie in -180 .. 180 and "
                f"its latitude in -90 .. 90; got {at.x:g} and {at.y:g}"
            )


def _report_strangers(names: list[str], path: Path) -> None:
    if names:
        logger.warning("%s: names photos that the folder does not have: %s", path, named(names))


def _example(names: Collection[str], images: Iterable[ImageFile]) -> str:
    """One name of each side, for messages about names that do not fit."""
    theirs = shown_name(next(iter(names), "none"))
    ours = shown_name(min((image.name for image in images), default="none"))
    return f" (the file has e.g. {theirs!r}, the folder {ours!r})"
