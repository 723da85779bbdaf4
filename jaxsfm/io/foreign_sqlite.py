"""Reads the tables of an SQLite database that somebody else made, in bounded time and memory.

Such a file can be a program: a view, a virtual table or a generated column computes its rows when
they are asked for, and need not end. A damaged file can have pages that lead to each other, so that
its rows come again and again. So only stored tables are read, and nothing may be larger, or take
longer, than the size of the file allows.
"""

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt

INSTRUCTIONS_PER_BYTE = 10
"""Instructions of SQLite's machine that reading may take for each byte of the file. A row of four
columns takes at least nine bytes (two for its place in the page, two for its length and its number,
five for the types of its columns) and six instructions, so one would do."""
FEWEST_INSTRUCTIONS = 1_000_000
"""Those of a small file, whose schema takes more than its rows."""
CHECKED_EVERY = 10_000
"""Instructions between two questions whether to go on: about a millisecond."""


class ForeignDatabase:
    """An open database that somebody else made. `opened` makes it.

    Args:
      size: the bytes of the file and of its log.
      where: beginning of messages.
    """

    def __init__(self, db: sqlite3.Connection, size: int, where: str) -> None:
        self._db, self._size, self.where = db, size, where
        self._questions = max(FEWEST_INSTRUCTIONS, INSTRUCTIONS_PER_BYTE * size) // CHECKED_EVERY
        # No value is longer than the file. SQLite's smallest limit for values is far below this.
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(max(size, 65_536), 2**31 - 1))
        # The type says whether a value was a text or a blob, and a caller can say which row it is.
        db.text_factory = lambda data: data.decode("utf-8", "surrogateescape")
        for setting in ("query_only = ON", "trusted_schema = OFF", "cell_size_check = ON"):
            db.execute(f"PRAGMA {setting}")
        db.set_progress_handler(self._must_stop, CHECKED_EVERY)

    def _must_stop(self) -> bool:
        """Whether reading has taken too long. Python notices Ctrl-C when it comes here."""
        self._questions -= 1
        return self._questions < 0

    def has_ended(self) -> bool:
        """Whether reading was stopped because it took too long."""
        return self._questions < 0

    def rows(self, table: str, columns: Sequence[str]) -> Iterator[tuple[Any, ...]]:
        """The rows of a stored table, in the order in which they are stored.

        Texts that are not UTF-8 have surrogates (`surrogateescape`).

        Raises:
          UserError: there is no such table or column, or it is not stored, or its rows are longer
            than the file.
          sqlite3.Error: the file is damaged.
        """
        self._check_stored(table, columns)
        read = 0
        for row in self._db.execute(f"SELECT {', '.join(columns)} FROM {table}"):
            read += 1 + sum(len(value) for value in row if isinstance(value, bytes | str))
            if read > self._size:
                raise UserError(f"{self.where}: damaged: {table} has more rows than its bytes hold")
            yield row

    def _check_stored(self, table: str, columns: Sequence[str]) -> None:
        """Raise UserError if a table or one of its columns is missing or computed."""
        query = (
            "SELECT type, rootpage, sql FROM sqlite_master "
            "WHERE name = ? COLLATE NOCASE AND type IN ('table', 'view')"
        )
        found = self._db.execute(query, (table,)).fetchone()
        if found is None:
            raise UserError(f"{self.where}: no table {table}")
        if not _is_stored(*found):
            raise UserError(
                f"{self.where}: {table} is a view or a virtual table; only tables whose rows are "
                "stored are read"
            )
        kinds = {row[1].lower(): row[6] for row in self._db.execute(f"PRAGMA table_xinfo({table})")}
        for column in columns:
            if column.lower() not in kinds:
                raise UserError(f"{self.where}: {table} has no column {column}")
            if kinds[column.lower()]:
                raise UserError(f"{self.where}: {table}: the column {column} is computed")

    def check_inert(self) -> None:
        """Raise UserError if a change of a row would run anything that the database brings with it,
        such as a trigger."""
        query = "SELECT type, rootpage, sql FROM sqlite_master WHERE type != 'index'"
        if not all(_is_stored(*row) for row in self._db.execute(query)):
            raise UserError(
                f"{self.where}: has triggers, views or virtual tables, which COLMAP's databases "
                "do not have; nothing is added to it"
            )


def _is_stored(kind: object, page: object, sql: object) -> bool:
    """Whether an entry of the schema is a table that has pages of its own."""
    text = sql.upper() if isinstance(sql, str) else ""
    return (
        kind == "table" and isinstance(page, int) and page > 0 and text.startswith("CREATE TABLE")
    )


@contextlib.contextmanager
def opened(path: Path, *, where: str) -> Iterator[ForeignDatabase]:
    """Open a database for reading. Neither it nor its folder is changed.

    Args:
      where: beginning of messages, such as an option and the file.

    Raises:
      UserError: there is no such file, or reading it does not end.
      sqlite3.Error: it is damaged, or no database.
      KeyboardInterrupt: Ctrl-C was pressed.
    """
    if not path.is_file():
        raise UserError(f"{where}: no such file")
    # A database of COLMAP has a log file beside it while it is open. sqlite3 makes this file even
    # to read, unless it is told that nobody writes. An existing log holds data that the database
    # does not hold yet.
    # SQLite writes into the index of that log, which must not be a file of another place too.
    index = path.with_name(path.name + "-shm")
    if index.is_file() and index.stat().st_nlink > 1:
        raise UserError(f"{where}: {index.name} beside it is another file too; delete it")
    log = path.with_name(path.name + "-wal")
    how = "mode=ro" if log.is_file() else "immutable=1"
    size = path.stat().st_size + (log.stat().st_size if log.is_file() else 0)
    address = f"file:{quote(str(path.absolute()), errors='surrogateescape')}?{how}"
    with contextlib.closing(sqlite3.connect(address, uri=True)) as db:
        file = ForeignDatabase(db, size, where)
        try:
            yield file
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_INTERRUPT:
                raise
            if file.has_ended():
                raise UserError(f"{where}: damaged: reading it does not end") from error
            # An exception in the progress handler, which sqlite3 does not pass on.
            interrupt.check()
            raise KeyboardInterrupt from error
