"""Databases of strangers: what ends COLMAP's process is refused before, and reading them ends."""

import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from foreign_model import NAMES, camera, exact_model, write_run

from jaxsfm.colmap.formats.database import check_database, read_database
from jaxsfm.errors import UserError
from jaxsfm.io.foreign_sqlite import opened
from jaxsfm.io.interrupt import noted


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The database of a right run."""
    folder = tmp_path_factory.mktemp("whole")
    write_run(folder, exact_model([camera("PINHOLE")], points=20), with_model=False)
    return folder / "database.db"


def changed(whole: Path, folder: Path, sql: str) -> Path:
    path = folder / "d.db"
    shutil.copyfile(whole, path)
    db = sqlite3.connect(path)
    for setting in ("foreign_keys = OFF", "journal_mode = DELETE", "legacy_alter_table = ON"):
        db.execute(f"PRAGMA {setting}")
    db.executescript(sql)
    db.close()
    return path


FATAL = {
    "an index out of range": "UPDATE matches SET data = zeroblob(length(data) - 4) || x'ffffff7f'",
    "keypoints that are cut off": "UPDATE keypoints SET data = x'0102'",
    "more keypoints than memory": "UPDATE keypoints SET rows = 4611686018427387904",
    "a negative number": "UPDATE keypoints SET rows = -1",
    "three columns": "UPDATE keypoints SET cols = 3, data = zeroblob(rows * 12)",
    "no columns": "UPDATE keypoints SET cols = 0, data = NULL",
    "a camera of no model": "UPDATE cameras SET model = 99",
    "a camera without parameters": "UPDATE cameras SET params = NULL",
    "an image without a camera": "UPDATE images SET camera_id = 77",
}
ALONE = """
import resource, sys
import pycolmap

used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), used + (1 << 30)))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
pycolmap.logging.minloglevel = 3
options = pycolmap.GeometricVerifierOptions(num_threads=1)
pycolmap.geometric_verification(sys.argv[1], verifier_options=options)
print("verified")
"""


@pytest.mark.parametrize("damage", list(FATAL))
def test_what_ends_colmap_is_refused_before(tmp_path, whole, damage):
    path = changed(whole, tmp_path, FATAL[damage])
    with pytest.raises(UserError, match=r"^d\.db: (keypoints|matches|cameras|images), row \d+"):
        check_database(path, where="d.db")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory in this way")
@pytest.mark.parametrize("damage", list(FATAL))
def test_colmap_alone_ends_its_process(tmp_path, whole, damage):
    """The reason for a reader of our own: COLMAP's verification aborts or reads beyond its data."""
    path = changed(whole, tmp_path, FATAL[damage])
    done = subprocess.run([sys.executable, "-c", ALONE, str(path)], capture_output=True, text=True)
    assert done.returncode in (-signal.SIGABRT, -signal.SIGSEGV), done.stdout


def test_the_numbers_of_the_images_of_a_right_database_are_returned(whole):
    assert sorted(check_database(whole, where="d.db").items()) == [
        (name, k + 1) for k, name in enumerate(NAMES)
    ]


ENDLESS = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
COMPUTED = {
    "an endless view": "ALTER TABLE {0} RENAME TO old;"
    f"CREATE VIEW {{0}} AS {ENDLESS} SELECT n AS {{1}} FROM c",
    "an endless view without rows": "ALTER TABLE {0} RENAME TO old;"
    f"CREATE VIEW {{0}} AS {ENDLESS} SELECT n AS {{1}} FROM c WHERE n < 0",
    "a virtual table": "DROP TABLE {0}; CREATE VIRTUAL TABLE {0} USING dbstat",
    "a generated column": "CREATE TABLE new AS SELECT * FROM {0}; DROP TABLE {0};"
    "ALTER TABLE new DROP COLUMN {1}; ALTER TABLE new RENAME TO {0};"
    "ALTER TABLE {0} ADD COLUMN {1} AS (zeroblob(1000000000))",
    "no table": "DROP TABLE {0}",
    "no column": "ALTER TABLE {0} RENAME COLUMN {1} TO other",
}
READ = {
    "cameras": "params",
    "images": "name",
    "keypoints": "data",
    "matches": "data",
    "two_view_geometries": "data",
}


@pytest.mark.parametrize("table", list(READ))
@pytest.mark.parametrize("kind", list(COMPUTED))
def test_only_stored_tables_are_read(tmp_path, whole, kind, table):
    sql = COMPUTED[kind].format(table, READ[table])
    if kind == "a generated column" and table == "images":  # its name is unique
        sql = f"DROP TABLE images; CREATE TABLE images (image_id, name AS ('{table}'), camera_id)"
    path = changed(whole, tmp_path, sql)
    start = time.process_time()
    for read in (read_database, check_database):
        with pytest.raises(UserError, match=f"^d.db: .*{table}|^d.db: has triggers, views"):
            read(path, where="d.db")
    assert time.process_time() - start < 5


def test_views_and_triggers_that_are_not_read_do_no_harm(tmp_path, whole):
    view = f"CREATE VIEW other AS {ENDLESS} SELECT n FROM c;"
    trigger = "CREATE TRIGGER t AFTER INSERT ON images BEGIN DELETE FROM images; END"
    path = changed(whole, tmp_path, view + trigger)
    assert sorted(read_database(path, where="d.db").sizes) == NAMES
    with pytest.raises(UserError, match="d.db: has triggers, views or virtual tables"):
        check_database(path, where="d.db")


def test_rows_that_come_again_are_refused(tmp_path, whole):
    sql = "CREATE TABLE new AS SELECT * FROM {0} UNION ALL SELECT * FROM {0}; DROP TABLE {0};"
    for table in READ:
        path = changed(whole, tmp_path, sql.format(table) + f"ALTER TABLE new RENAME TO {table}")
        with pytest.raises(UserError, match=rf"^d.db: {table}, row \d.* is there twice$"):
            read_database(path, where="d.db")
        path.unlink()


def test_a_value_is_never_larger_than_the_file(whole):
    """The pages of a damaged file can lead to each other."""
    assert whole.stat().st_size < 10_000_000
    with opened(whole, where="d.db") as file:
        with pytest.raises(sqlite3.Error, match="too big"):
            file._db.execute("SELECT zeroblob(10000000)").fetchall()


def test_what_does_not_end_is_stopped(whole):
    start = time.process_time()
    with pytest.raises(UserError, match="^d.db: damaged: reading it does not end$"):
        with opened(whole, where="d.db") as file:
            file._db.execute(f"{ENDLESS} SELECT n FROM c WHERE n < 0").fetchall()
    assert time.process_time() - start < 5


def test_ctrl_c_is_obeyed_while_sqlite_searches(whole, monkeypatch):
    monkeypatch.setattr("jaxsfm.io.foreign_sqlite.FEWEST_INSTRUCTIONS", 10**10)
    with pytest.raises(KeyboardInterrupt), noted():  # a worker of the tests ignores SIGINT
        threading.Timer(0.3, signal.raise_signal, [signal.SIGINT]).start()
        with opened(whole, where="d.db") as file:
            file._db.execute(f"{ENDLESS} SELECT n FROM c WHERE n < 0").fetchall()


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (["a.png", "./a.png"], "'./a.png' and 'a.png' cannot both be files of one folder"),
        (["a.png", "a.png/keypoints"], "'a.png' and 'a.png/keypoints' cannot both be files"),
        (["s/b.png", "a", "s-", "s"], "'s' and 's/b.png' cannot both be files"),
        (["a\0.png"], "images, row 1: '.*' names no file"),
        (["./"], "images, row 1: './' names no file"),
        (["a" * 5000], "images, row 1: a name of 5000 bytes"),
    ],
)
def test_names_that_are_not_those_of_files_in_one_folder_are_refused(tmp_path, whole, names, why):
    path = changed(whole, tmp_path, "DELETE FROM images")
    with sqlite3.connect(path) as db:
        db.executemany("INSERT INTO images VALUES (?, ?, 1)", list(enumerate(names, 1)))
    with pytest.raises(UserError, match=f"^d.db: .*{why}"):
        read_database(path, where="d.db")


def test_whole_numbers_that_sqlite_holds_as_reals_are_integers(tmp_path, whole):
    sql = (
        "CREATE TABLE new AS SELECT pair_id + 0.0 AS pair_id, rows + 0.0 AS rows, 2.0 AS cols, data"
        " FROM matches; DROP TABLE matches; ALTER TABLE new RENAME TO matches"
    )
    found = read_database(changed(whole, tmp_path, sql), where="d.db")
    wanted = read_database(whole, where="d.db")
    assert found.matches.keys() == wanted.matches.keys()
    assert all((found.matches[pair] == rows).all() for pair, rows in wanted.matches.items())
