"""Reads COLMAP's database without COLMAP. Every row is checked here, whichever command needs it.

COLMAP changes a database when it opens one: it writes tables that are missing into the file, or
into an empty file. It does not notice keypoints or matches of images that are not there. In its
verification, an index out of range or a blob of a wrong length ends the process, and keypoints
without columns are read for ever (`tests/colmap/test_foreign_databases.py` shows it). So another
tool's database is read with sqlite3. Tables and blobs: https://colmap.github.io/database.html.
"""

import contextlib
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sized
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsfm.colmap.database import PIXEL_OFFSET
from jaxsfm.colmap.formats.tables import (
    MAX_KEYPOINTS,
    MAX_SIDE,
    Tables,
    camera_fault,
    checked_keypoints,
    checked_matches,
    clash,
    clash_fault,
    focal_length,
    name_fault,
)
from jaxsfm.errors import UserError
from jaxsfm.io.foreign_sqlite import ForeignDatabase, opened
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair

MAX_IMAGES = 2**31 - 1
"""The id of a pair is this times the lesser id of its images, plus the other id."""
MAX_CAMERAS = 2**32 - 1
"""COLMAP's number of no camera."""
COLMAPS_WIDTHS = (2, 4, 6)
"""Columns of a keypoint in COLMAP: its place; scale and angle; or an affine shape. With any other
number, COLMAP's verification ends the process."""
WIDTHS = range(2, 17)
"""Columns of a keypoint of any tool, of which the first two are its place."""
KEYPOINTS = ("image_id", "rows", "cols", "data")
PAIRS = ("pair_id", "rows", "cols", "data")


class _Row(NamedTuple):
    """A row of a table. Its values are asked for by column and by kind."""

    where: str
    """The database, the table and the number of the row."""
    values: Mapping[str, Any]

    def bad(self, what: str) -> UserError:
        return UserError(f"{self.where}: {what}")

    def integer(self, column: str, least: int, most: int) -> int:
        """An integer; UserError if it is none, or out of range. SQLite may hold it as 3.0."""
        value = self.values[column]
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int) or not least <= value <= most:
            raise self.bad(f"{column} must be an integer of {least} .. {most}; got {_shown(value)}")
        return value

    def blob(self, column: str) -> bytes:
        """Bytes. COLMAP writes nothing, and not an empty blob, where there are none."""
        value = self.values[column]
        if value is None:
            return b""
        if not isinstance(value, bytes):
            raise self.bad(f"{column} must be a blob; got {_shown(value)}")
        return value

    def table(self, dtype: type, widths: Collection[int]) -> np.ndarray:
        """The table of numbers (rows, cols) in `data`.

        Args:
          widths: the numbers of columns that it may have. Without rows, it may have none.
        """
        rows = self.integer("rows", 0, MAX_KEYPOINTS)
        columns = self.integer("cols", 0, max(WIDTHS))
        if columns not in widths and (rows or columns):
            raise self.bad(f"cols must be {', '.join(map(str, widths))}; got {columns}")
        data = self.blob("data")
        size = rows * columns * np.dtype(dtype).itemsize
        if len(data) != size:
            raise self.bad(
                f"{rows} x {columns} values expected in data, which are {size} bytes; "
                f"got {len(data)} bytes"
            )
        return np.frombuffer(data, dtype).reshape(rows, columns or min(widths))


def _shown(value: object) -> str:
    """A value for messages."""
    if isinstance(value, bytes):
        return f"a blob of {len(value)} bytes"
    if isinstance(value, str):
        return f"the text {shown_name(value[:40])!r}"
    return "nothing" if value is None else repr(value)


class _Camera(NamedTuple):
    """What is read of a camera."""

    size: tuple[int, int]
    focal_px: float | None
    """The focal length in x, if it was known before mapping."""


class _Image(NamedTuple):
    """What is read of an image."""

    name: str
    camera: _Camera


class _Rows:
    """The checked rows of a COLMAP database, table after table.

    Args:
      file: every table of it is read once. UserError if a camera or an image is damaged.
    """

    def __init__(self, file: ForeignDatabase) -> None:
        self._file = file
        cameras = dict(self._cameras())
        self.images = dict(self._images(cameras))
        if both := clash(image.name for image in self.images.values()):
            raise UserError(f"{file.where}: images: {clash_fault(both)}")

    def _rows(self, table: str, columns: tuple[str, ...]) -> Iterator[_Row]:
        for number, values in enumerate(self._file.rows(table, columns), 1):
            where = f"{self._file.where}: {table}, row {number}"
            yield _Row(where, dict(zip(columns, values, strict=True)))

    def _cameras(self) -> Iterator[tuple[int, _Camera]]:
        seen = set()
        columns = ("camera_id", "model", "width", "height", "params", "prior_focal_length")
        for row in self._rows("cameras", columns):
            camera_id = row.integer("camera_id", 0, MAX_CAMERAS - 1)
            _once(row, f"camera {camera_id}", camera_id, seen)
            model = row.integer("model", -(2**31), 2**31 - 1)
            size = row.integer("width", 1, MAX_SIDE), row.integer("height", 1, MAX_SIDE)
            data = row.blob("params")
            if len(data) % 8:
                raise row.bad(f"params must hold numbers of 8 bytes; got {len(data)} bytes")
            params = np.frombuffer(data, np.float64).tolist()
            if fault := camera_fault(model, size, params):
                raise row.bad(fault)
            known = row.values["prior_focal_length"] is not None and row.integer(
                "prior_focal_length", -(2**63), 2**63 - 1
            )
            yield camera_id, _Camera(size, focal_length(model, params) if known else None)

    def _images(self, cameras: Mapping[int, _Camera]) -> Iterator[tuple[int, _Image]]:
        seen = set()
        for row in self._rows("images", ("image_id", "name", "camera_id")):
            image_id = row.integer("image_id", 0, MAX_IMAGES - 1)
            _once(row, f"image {image_id}", image_id, seen)
            name = row.values["name"]
            if not isinstance(name, str):
                raise row.bad(f"name must be a text; got {_shown(name)}")
            if fault := name_fault(name):
                raise row.bad(fault)
            camera_id = row.integer("camera_id", 0, MAX_CAMERAS - 1)
            if camera_id not in cameras:
                raise row.bad(f"names camera {camera_id}, which is not in the database")
            yield image_id, _Image(name, cameras[camera_id])

    def keypoints(self, widths: Collection[int]) -> Iterator[tuple[str, np.ndarray]]:
        """The name and the keypoints float32 (n, 2) of every image that has an entry, in COLMAP's
        pixels.

        Args:
          widths: the numbers of columns that keypoints may have.
        """
        seen = set()
        for row in self._rows("keypoints", KEYPOINTS):
            image_id = row.integer("image_id", 0, MAX_IMAGES - 1)
            if image_id not in self.images:
                raise row.bad(f"keypoints of image {image_id}, which is not in the database")
            name = self.images[image_id].name
            own = row._replace(where=f"{row.where} ({shown_name(name)})")
            _once(own, "the image", image_id, seen)
            yield name, checked_keypoints(own.table(np.float32, widths), own.where)

    def pairs(
        self, table: str, keypoints: Mapping[str, Sized]
    ) -> Iterator[tuple[Pair, np.ndarray]]:
        """Every pair that has matches, and int32 (m, 2): the indices of their keypoints.

        Args:
          table: `matches` or `two_view_geometries`.
        """
        seen = set()
        for row in self._rows(table, PAIRS):
            pair_id = row.integer("pair_id", 0, MAX_IMAGES**2)
            ids = divmod(pair_id, MAX_IMAGES)
            for image_id in ids:
                if image_id not in self.images:
                    raise row.bad(f"names image {image_id}, which is not in the database")
            _once(row, "the pair", frozenset(ids), seen)
            names = self.images[ids[0]].name, self.images[ids[1]].name
            rows = row.table(np.uint32, (2,)).astype(np.int64)
            if len(rows):
                yield checked_matches(rows, names, keypoints, row.where)


def _once(row: _Row, what: str, key: object, seen: set) -> None:
    """Raise UserError if a key came before. A damaged file may have a row without an end."""
    if key in seen:
        raise row.bad(f"{what} is there twice")
    seen.add(key)


@contextlib.contextmanager
def _reading(path: Path, where: str) -> Iterator[ForeignDatabase]:
    """Open a database; UserError if it is none, or damaged."""
    try:
        with opened(path, where=where) as file:
            yield file
    except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter: SQLite's own message
        why = shown_name(str(error))[:200]
        raise UserError(f"{where}: not a readable COLMAP database ({why})") from error


def read_database(path: Path, *, where: str) -> Tables:
    """Read cameras, keypoints and matches from a COLMAP database.

    Args:
      where: beginning of messages, such as an option and the file.

    Raises:
      UserError: the file is no database, is damaged, or is inconsistent: an index is out of range,
        two images have one name, or a match is of an image that it does not have. The message says
        in which row.
    """
    with _reading(path, where) as file:
        rows = _Rows(file)
        sizes = {image.name: image.camera.size for image in rows.images.values()}
        focal_px = {
            image.name: image.camera.focal_px
            for image in rows.images.values()
            if image.camera.focal_px is not None
        }
        keypoints = {name: xy - PIXEL_OFFSET for name, xy in rows.keypoints(WIDTHS)}
        matches = dict(rows.pairs("matches", keypoints))
        inliers = dict(rows.pairs("two_view_geometries", keypoints))
    return Tables(sizes, focal_px, keypoints, matches, inliers)


def check_database(path: Path, *, where: str) -> dict[str, int]:
    """Check a COLMAP database before COLMAP itself adds to it. No table is held in memory.

    Returns:
      the numbers of its images, by name.

    Raises:
      UserError: `read_database` would refuse it, it holds what would run when rows are added, or
        COLMAP cannot read the shape of a keypoint.
    """
    with _reading(path, where) as file:
        file.check_inert()
        rows = _Rows(file)
        counts = {name: range(len(xy)) for name, xy in rows.keypoints(COLMAPS_WIDTHS)}
        for table in ("matches", "two_view_geometries"):
            for _ in rows.pairs(table, counts):
                pass
    return {image.name: image_id for image_id, image in rows.images.items()}
