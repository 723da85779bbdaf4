"""Odd rows in databases of strangers: tables, or one sentence; and COLMAP can read what passes.

Each case puts one to three odd things into a right database, in any table and column.
"""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from foreign_model import NAMES, camera, exact_model, image_files, results_of, write_run
from fuzz_children import run_cases
from mutations import damaged, outcome

from jaxsfm.cli.export_commands import export
from jaxsfm.colmap.extend_database import add_images, add_matches, copy_database, used_by_colmap
from jaxsfm.colmap.external_matches import read_external_matches
from jaxsfm.colmap.formats.database import check_database
from jaxsfm.colmap.two_views import VerificationOptions

POINTS = 20
NEW = "new.jpg"
BLOBS = [
    b"",
    b"\0",
    bytes(8),
    bytes(32),
    bytes(160),
    b"\xff" * 32,
    b"\xff" * 160,
    np.full(4, np.nan).tobytes(),
    np.full(40, np.inf, np.float32).tobytes(),
    np.full(40, -1e38, np.float32).tobytes(),
    np.arange(40, dtype=np.uint32).tobytes(),
    bytes(1_000_000),
]
TEXTS = [
    "",
    ".",
    "/",
    "..",
    "0",
    "7",
    "a.jpg",
    "./a.jpg",
    "a.jpg/",
    "a.jpg/keypoints",
    "sub",
    "sub/b.jpg",
    "sub//b.jpg",
    "sub-b.jpg",
    "../a.jpg",
    "/a.jpg",
    "a\0b",
    "a\nb.jpg",
    "x" * 300,
    "x/" * 3000,
    "\u65e5.png",
]
NUMBERS = [0, 1, -1, 2, 3, 77, 255, 10**7, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**62, 2**63 - 1]
REALS = [0.0, 0.5, 1.0, -2.5, 1e18, 1e308, float("inf"), float("-inf"), float("nan")]
ODD = [None, *BLOBS, *TEXTS, *NUMBERS, -(2**63), *REALS]
ENDLESS = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT {} FROM c"
FILTERED = (
    "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT {} FROM c WHERE n < 0"
)
LONG = "SELECT {} FROM old, (VALUES (1), (2), (3)), (VALUES (1), (2), (3))"


def pick(rng, choices):
    return choices[int(rng.integers(len(choices)))]


def run_folder(folder: Path) -> Path:
    """The folder of a right run, made once."""
    run = folder / "whole"
    if not run.exists():
        write_run(run, exact_model([camera("PINHOLE")], points=POINTS), with_model=False)
        with sqlite3.connect(run / "database.db") as db:
            db.execute("PRAGMA journal_mode = DELETE")
    return run


def columns_of(db: sqlite3.Connection, table: str) -> list[str]:
    return [row[1] for row in db.execute(f"PRAGMA table_info({table})")]


def tables_of(db: sqlite3.Connection) -> list[str]:
    query = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
    return [name for (name,) in db.execute(query)]


def untyped(db: sqlite3.Connection, table: str) -> None:
    """Take the types and the constraints of a table away, so that it holds anything."""
    db.execute(f"CREATE TABLE bare AS SELECT * FROM {table}")
    columns = ", ".join(columns_of(db, table))
    db.execute(f"DROP TABLE {table}")
    db.execute(f"CREATE TABLE {table} ({columns})")
    db.execute(f"INSERT INTO {table} SELECT * FROM bare")
    db.execute("DROP TABLE bare")


def odd_value(db, table, rng) -> None:
    column = pick(rng, columns_of(db, table))
    row = f"(SELECT rowid FROM {table} LIMIT 1 OFFSET {rng.integers(4)})"
    which = pick(rng, ["", f"WHERE rowid = {row}", f"WHERE rowid = {row}"])
    value = pick(rng, ODD)
    if rng.random() < 0.2:
        change = pick(rng, ["-{0}", "{0} + 0.0", "{0} + 0.5", "CAST({0} AS TEXT)", "zeroblob({0})"])
        db.execute(f"UPDATE {table} SET {column} = {change.format(column)} {which}")
    else:
        db.execute(f"UPDATE {table} SET {column} = ? {which}", (value,))


def odd_blob(db, table, rng) -> None:
    """The bytes of a blob cut, doubled or replaced, where a table has blobs."""
    if "data" not in columns_of(db, table):
        return odd_value(db, table, rng)
    change = pick(
        rng,
        [
            "substr(data, 1, length(data) - 1)",
            "substr(data, 5)",
            "CAST(data || data AS BLOB)",
            "CAST(x'0000c07f' || substr(data, 5) AS BLOB)",
            "CAST(x'ffffffff' || substr(data, 5) AS BLOB)",
            "zeroblob(length(data))",
        ],
    )
    return db.execute(f"UPDATE {table} SET data = {change}")


def new_row(db, table, rng) -> None:
    """A row that is there already, with the first value and another one changed; or odd values."""
    columns = columns_of(db, table)
    values = [pick(rng, ODD) for _ in columns]
    if rng.random() < 0.8:
        values = list(db.execute(f"SELECT * FROM {table}").fetchone() or values)
        values[0] = pick(rng, [values[0], 9, 4294967301, None])
        at = int(rng.integers(1, len(values)))
        values[at] = pick(rng, ODD if columns[at] != "name" else TEXTS)
    db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(columns))})", values)


def missing(db, table, rng) -> None:
    kind = rng.integers(4)
    if kind == 0:
        db.execute(f"DROP TABLE {table}")
    elif kind == 1:
        db.execute(f"DELETE FROM {table} WHERE rowid = (SELECT min(rowid) FROM {table})")
    elif kind == 2:
        db.execute(f"DELETE FROM {table}")
    else:
        column = pick(rng, columns_of(db, table))
        db.execute(f"ALTER TABLE {table} RENAME COLUMN {column} TO other")


def computed(db, table, rng) -> None:
    """A view, a virtual table, a generated column, a trigger or an index of an expression."""
    columns = columns_of(db, table)
    kind = rng.integers(6)
    if kind < 2:
        db.execute(f"ALTER TABLE {table} RENAME TO old")
        body = pick(rng, [ENDLESS, FILTERED, LONG, "SELECT {} FROM old"])
        source = columns if "old" in body else ["n"] * len(columns)
        each = ", ".join(f"{a} AS {b}" for a, b in zip(source, columns, strict=True))
        db.execute(f"CREATE VIEW {table} AS {body.format(each)}")
    elif kind == 2:
        db.execute(f"ALTER TABLE {table} RENAME TO old")
        module = pick(rng, ["fts5", "rtree_i32", "dbstat"])
        args = {"dbstat": ""}.get(module, f"({', '.join(columns[:5])})")
        db.execute(f"CREATE VIRTUAL TABLE {table} USING {module}{args}")
    elif kind == 3:
        column = pick(rng, columns)
        rest = [each for each in columns if each != column]
        values = pick(
            rng, ["zeroblob(1000000000)", "1", "randomblob(20000)", "printf('%.*c', 9999999, 'x')"]
        )
        db.execute(f"ALTER TABLE {table} RENAME TO old")
        how = pick(rng, ["VIRTUAL", "VIRTUAL", "STORED" if "00000" not in values else "VIRTUAL"])
        db.execute(f"CREATE TABLE {table} ({', '.join(rest)}, {column} AS ({values}) {how})")
        db.execute(f"INSERT INTO {table} SELECT {', '.join(rest)} FROM old")
    elif kind == 4:
        endless = "WITH RECURSIVE c(n) AS (SELECT 9 UNION ALL SELECT n + 1 FROM c) SELECT n FROM c"
        db.execute(
            f"CREATE TRIGGER t AFTER INSERT ON {table} BEGIN SELECT max(n) FROM ({endless}); END"
        )
    else:
        db.execute(f"CREATE INDEX odd_index ON {table} (abs({pick(rng, columns)}))")


def schema_text(db, table, rng) -> None:
    """The text of the schema itself changed, as no command of SQLite does."""
    db.execute("PRAGMA writable_schema = ON")
    change = pick(
        rng,
        [
            f"sql = replace(sql, 'CREATE TABLE {table}', 'CREATE VIEW {table} AS SELECT 1; --')",
            "sql = 'CREATE TABLE x'",
            "sql = NULL",
            "rootpage = 0",
            "rootpage = 1",
            "rootpage = rootpage + 1",
            "type = 'view'",
            "sql = sql || char(0) || '\u65e5'",
            "sql = CAST(x'435245415445205441424C4520FF' AS TEXT)",
        ],
    )
    db.execute(f"UPDATE sqlite_master SET {change} WHERE name = ?", (table,))


KINDS = (odd_value, odd_value, odd_value, odd_blob, new_row, missing, computed, schema_text)


def odd_database(rng, folder: Path) -> Path:
    """A copy of the right run with an odd database."""
    run = folder / "run"
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir()
    path = run / "database.db"
    shutil.copyfile(run_folder(folder) / "database.db", path)
    if rng.random() < 0.1:
        path.write_bytes(damaged(path.read_bytes(), rng))
        return run
    db = sqlite3.connect(path, isolation_level=None)
    db.set_progress_handler(iter([False] * 20 + [True] * 10_000).__next__, 50_000)  # for triggers
    for setting in ("foreign_keys = OFF", "legacy_alter_table = ON", "journal_mode = OFF"):
        db.execute(f"PRAGMA {setting}")
    for setting in ("ignore_check_constraints = ON", "synchronous = OFF"):
        db.execute(f"PRAGMA {setting}")
    read = [t for t in tables_of(db) if t not in ("descriptors", "pose_priors")]
    for _ in range(rng.integers(1, 4)):
        table = pick(
            rng, ["cameras", "images", "keypoints", "matches", "two_view_geometries", *read]
        )
        if not columns_of(db, table):  # it is gone
            continue
        try:
            if rng.random() < 0.5:
                untyped(db, table)
            pick(rng, KINDS)(db, table, rng)
        except sqlite3.Error:  # a constraint of the table, or nothing to change any more
            continue
    db.close()
    return run


def database(rng, folder: Path) -> str:
    run, out = odd_database(rng, folder), folder / "out"
    path = run / "database.db"
    before = path.read_bytes()
    shutil.rmtree(out, ignore_errors=True)
    how, _ = outcome(lambda: export(run, to="hloc", out=out), path, "--to hloc")
    assert out.exists() == (how == "read")
    images = image_files(NAMES, folder)
    option = f"--with-database {path}"
    beside, _ = outcome(lambda: read_external_matches(path, None, images, None), option)
    assert how == "read" or beside == "refused" or _only_hlocs(run)
    assert path.read_bytes() == before and [each.name for each in run.iterdir()] == [path.name]
    return how


def _only_hlocs(run: Path) -> bool:
    """Whether the names of a database are those that only hloc's files cannot hold."""
    with sqlite3.connect(run / "database.db") as db:
        names = [name for (name,) in db.execute("SELECT name FROM images")]
    short = {name.replace("/", "-") for name in names}
    return len(short) < len(names) or any(len(name.split()) != 1 for name in names)


def extended(rng, folder: Path) -> str:
    """A photo is added to the odd database, which COLMAP then reads and verifies."""
    run, copy = odd_database(rng, folder), folder / "copy.db"
    source = run / "database.db"
    model = exact_model([camera("PINHOLE")], [*NAMES, NEW], POINTS)
    results = {pair: r for pair, r in results_of(model).items() if NEW in pair}
    (new,) = image_files([NEW], folder)

    def extend() -> None:
        numbers = check_database(source, where=str(source))
        copy_database(source, copy, 100)
        there = {pair: r for pair, r in results.items() if numbers.keys() >= {*pair} - {NEW}}
        with used_by_colmap(source):
            add_images(copy, {NEW: (new, model.camera(1))})
            add_matches(copy, there, VerificationOptions(threads=1))

    return outcome(extend, source)[0]


@pytest.mark.parametrize("kind", ["database", "extended"])
def test_an_odd_database_is_read_or_refused_by_name(tmp_path, share, least, kind):
    cases = {"database": 2000, "extended": 600}[kind]
    found = run_cases(
        "test_fuzz_databases", kind, round(cases * share), tmp_path, patience_s=600 * share + 60
    )
    assert found["read"] > cases / 20 * least and found["refused"] > cases / 3 * least
