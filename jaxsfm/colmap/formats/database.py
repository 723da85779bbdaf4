"""Reads COLMAP's database without COLMAP.

COLMAP changes a database when it opens one: it writes tables that are missing into the file, or
into an empty file. It does not notice keypoints or matches of images that are not there. So another
tool's database is read with sqlite3. Tables and blobs: https://colmap.github.io/database.html.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

import numpy as np

from jaxsfm.colmap.database import PIXEL_OFFSET
from jaxsfm.colmap.formats.tables import MAX_KEYPOINTS, Tables, checked_keypoints, checked_matches
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair

MAX_IMAGES = 2**31 - 1
"""The id of a pair is this times the lesser id of its images, plus the other id."""
_DAMAGED = (sqlite3.Error, TypeError, ValueError, OverflowError, KeyError)


def _blob(rows: int, columns: int, data: object, dtype: type, where: str) -> np.ndarray:
    """Read a table from a blob. COLMAP writes no blob for a table without rows."""
    if data is None or rows == 0:
        return np.zeros((0, max(int(columns), 2)), dtype)
    if not isinstance(data, bytes) or rows > MAX_KEYPOINTS:
        raise UserError(f"{where}: damaged")
    table = np.frombuffer(data, dtype)
    if rows < 0 or columns < 2 or table.size != rows * columns:
        raise UserError(f"{where}: {rows} x {columns} values expected; got {table.size}")
    return table.reshape(rows, columns)


def _pairs(
    db: sqlite3.Connection,
    table: str,
    names: dict[int, str],
    keypoints: dict[str, np.ndarray],
    where: str,
) -> Iterator[tuple[Pair, np.ndarray]]:
    query = f"SELECT pair_id, rows, cols, data FROM {table}"
    for pair_id, count, columns, data in db.execute(query):
        a, b = divmod(pair_id, MAX_IMAGES)
        for image_id in (a, b):
            if image_id not in names:
                raise UserError(f"{where}: {table} name image {image_id}, which is not in it")
        own = f"{where}: {table} of {shown_name(names[a])} and {shown_name(names[b])}"
        rows = _blob(count, columns, data, np.uint32, own)[:, :2].astype(np.int64)
        if len(rows):
            yield checked_matches(rows, (names[a], names[b]), keypoints, where)


def read_database(path: Path, *, where: str) -> Tables:
    """Read cameras, keypoints and matches from a COLMAP database.

    Args:
      where: beginning of messages, such as an option and the file.

    Raises:
      UserError: the file is no database, is damaged, or is inconsistent: an index is out of range,
        two images have one name, or a match is of an image that it does not have.
    """
    if not path.is_file():
        raise UserError(f"{where}: no such file")
    # A COLMAP database has a log file beside it while it is open. sqlite3 makes this file even to
    # read, unless it is told that nobody writes. An existing log holds data that the database does
    # not hold yet.
    # SQLite writes into the index of that log, which must not be a file of another place too.
    index = path.with_name(path.name + "-shm")
    if index.is_file() and index.stat().st_nlink > 1:
        raise UserError(f"{where}: {index.name} beside it is another file too; delete it")
    how = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    try:
        address = f"file:{quote(str(path.absolute()), errors='surrogateescape')}?{how}"
        with closing(sqlite3.connect(address, uri=True)) as db:
            return _read(db, where)
    except _DAMAGED as error:
        raise UserError(f"{where}: not a readable COLMAP database ({error})") from error


def _read(db: sqlite3.Connection, where: str) -> Tables:
    cameras = {}
    for camera_id, width, height, params, known in db.execute(
        "SELECT camera_id, width, height, params, prior_focal_length FROM cameras"
    ):
        values = np.frombuffer(params).tolist()
        cameras[camera_id] = (int(width), int(height)), values[0] if known and values else None
    names, sizes, focal_px = {}, {}, {}
    for image_id, name, camera_id in db.execute("SELECT image_id, name, camera_id FROM images"):
        if not isinstance(name, str) or name in sizes:
            raise UserError(f"{where}: damaged: two images {name!r}")
        names[image_id] = name
        sizes[name], focal = cameras[camera_id]
        if focal is not None:
            focal_px[name] = focal
    keypoints = {}
    for image_id, rows, columns, data in db.execute(
        "SELECT image_id, rows, cols, data FROM keypoints"
    ):
        if image_id not in names:
            raise UserError(f"{where}: keypoints of image {image_id}, which is not in it")
        own = f"{where}: {shown_name(names[image_id])}"
        table = _blob(rows, columns, data, np.float32, own)
        keypoints[names[image_id]] = checked_keypoints(table, own) - PIXEL_OFFSET
    tables = [
        dict(_pairs(db, table, names, keypoints, where))
        for table in ("matches", "two_view_geometries")
    ]
    return Tables(sizes, focal_px, keypoints, tables[0], tables[1])
