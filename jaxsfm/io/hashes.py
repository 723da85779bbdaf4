"""Digests of the content of files and of SQLite databases."""

import contextlib
import hashlib
import sqlite3
from pathlib import Path


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's content, hexadecimal; the file is read in parts."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def rows_sha256(database: Path) -> str:
    """The SHA-256 of every row of every table of an SQLite database, hexadecimal.

    The file's own hash is of no use: COLMAP writes into a database's header whenever it opens it.

    Raises:
      sqlite3.DatabaseError: the database is damaged.
    """
    digest = hashlib.sha256()
    uri = f"{database.absolute().as_uri()}?mode=ro&immutable=1"
    with contextlib.closing(sqlite3.connect(uri, uri=True)) as db:
        query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
        for (table,) in db.execute(query).fetchall():
            for row in db.execute(f'SELECT * FROM "{table}" ORDER BY rowid'):
                for value in (table, *row):
                    data = value if isinstance(value, bytes) else repr(value).encode()
                    digest.update(b"%d:" % len(data) + data)
    return digest.hexdigest()
