"""Read COLMAP databases whole, so that two can be compared."""

import sqlite3
from pathlib import Path


def content(database: Path) -> dict[str, list]:
    """All rows of each table, by the table's name."""
    with sqlite3.connect(f"file:{database}?mode=ro", uri=True) as db:
        tables = [
            name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type='table'")
        ]
        return {
            name: sorted(db.execute(f"SELECT * FROM {name}").fetchall(), key=repr)
            for name in tables
        }
