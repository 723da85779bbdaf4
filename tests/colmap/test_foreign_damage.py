"""Readers of other tools' files: whatever is in them, a result or one sentence."""

import sqlite3

import h5py
import numpy as np
import pycolmap
import pytest
from foreign_model import NAMES, camera, exact_model, write_run
from mutations import mutated

from jaxsfm.colmap.formats.database import read_database
from jaxsfm.colmap.formats.hloc import FEATURES, MATCHES, read_hloc, write_hloc
from jaxsfm.errors import UserError

ROUNDS = 120


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_run(folder, exact_model([camera("PINHOLE")], points=20))
    tables = read_database(folder / "database.db", where="run")
    write_hloc(folder, tables, tables.matches, dict.fromkeys(tables.sizes, 1.0))
    for name in (FEATURES, MATCHES):  # without the checksums of the latest layout
        with h5py.File(folder / name) as old, h5py.File(folder / "copy.h5", "w") as new:
            for key in old:
                old.copy(key, new)
        (folder / "copy.h5").replace(folder / name)
    return folder


@pytest.mark.parametrize("which", ["database.db", FEATURES, MATCHES])
def test_a_damaged_file_gives_a_result_or_one_sentence(tmp_path, files, which):
    rng = np.random.default_rng(0)
    whole = (files / which).read_bytes()
    bad = tmp_path / which
    refused = 0
    for _ in range(ROUNDS):
        bad.write_bytes(mutated(whole, rng))
        try:
            if which == "database.db":
                read_database(bad, where="--with-database x")
            else:
                both = [bad if name == which else files / name for name in (FEATURES, MATCHES)]
                read_hloc(*both, NAMES, where="--with-hloc")
        except UserError as error:
            assert str(error).startswith("--with-")
            refused += 1
    assert refused > ROUNDS / 4


BAD_ROWS = {
    "keypoints of nobody": "UPDATE keypoints SET image_id = 99 WHERE image_id = 1",
    "matches of nobody": "UPDATE matches SET pair_id = pair_id + 90",
    "an image with itself": "UPDATE matches SET pair_id = 2147483647 * 2 + 2 WHERE pair_id = "
    "(SELECT min(pair_id) FROM matches)",
    "an image without a camera": "UPDATE images SET camera_id = 77",
    "fewer keypoints than matched": "UPDATE keypoints SET rows = 3, data = substr(data, 1, 24)",
    "rows that do not fit": "UPDATE keypoints SET rows = 3",
    "a text for a blob": "UPDATE keypoints SET data = 'abc'",
    "negative rows": "UPDATE matches SET rows = -1",
    "an image without a name": "UPDATE images SET name = x'ff' WHERE image_id = 1",
    "a broken blob": "UPDATE matches SET data = x'010203'",
    "not finite": "UPDATE keypoints SET data = zeroblob(4 * rows * cols - 4) || x'0000807f'",
    "no table": "DROP TABLE two_view_geometries",
}


@pytest.mark.parametrize("damage", list(BAD_ROWS))
def test_an_inconsistent_database_is_refused(tmp_path, files, damage):
    path = tmp_path / "d.db"
    path.write_bytes((files / "database.db").read_bytes())
    db = sqlite3.connect(path)
    db.execute("PRAGMA foreign_keys = off")
    db.execute(BAD_ROWS[damage])
    db.commit()
    db.close()
    with pytest.raises(UserError, match="^--with-database d.db: "):
        read_database(path, where="--with-database d.db")


def test_a_blob_of_another_size_is_named_with_its_image(tmp_path, files):
    path = tmp_path / "d.db"
    path.write_bytes((files / "database.db").read_bytes())
    db = sqlite3.connect(path)
    db.execute("UPDATE keypoints SET rows = 3 WHERE image_id = 2")
    db.commit()
    db.close()
    with pytest.raises(UserError, match=r"d.db: keypoints, row 2 .sub/b.jpg.: 3 x 2 values"):
        read_database(path, where="d.db")


def test_colmap_does_not_notice_what_a_database_lacks(tmp_path, files):
    """This, and the next test, is why we do not let COLMAP read other tools' databases."""
    path = tmp_path / "d.db"
    path.write_bytes((files / "database.db").read_bytes())
    db = sqlite3.connect(path)
    db.execute("PRAGMA foreign_keys = off")
    for damage in ("keypoints of nobody", "matches of nobody", "no table"):
        db.execute(BAD_ROWS[damage])
    db.commit()
    db.close()
    with pycolmap.Database.open(path) as db:
        assert len(db.read_all_images()) == len(NAMES) and db.num_verified_image_pairs() == 0


def test_reading_a_database_does_not_change_it(tmp_path, files):
    path = tmp_path / "some folder" / "d#1?.db"
    path.parent.mkdir()
    path.write_bytes((files / "database.db").read_bytes())
    path.chmod(0o444)
    assert len(read_database(path, where="x").keypoints) == len(NAMES)
    assert path.read_bytes() == (files / "database.db").read_bytes()
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    path.chmod(0o644)
    pycolmap.Database.open(path).close()
    assert path.read_bytes() != (files / "database.db").read_bytes()


@pytest.mark.parametrize("content", [b"", b"not a database", b"SQLite format 3\0" + bytes(90)])
def test_what_is_no_database_is_refused(tmp_path, content):
    path = tmp_path / "d.db"
    path.write_bytes(content)
    why = "not a readable COLMAP database" if content else "no table cameras"
    with pytest.raises(UserError, match=f"^--with-database d.db: {why}"):
        read_database(path, where="--with-database d.db")
    assert path.read_bytes() == content
    with pytest.raises(UserError, match="no such file"):
        read_database(tmp_path, where="--with-database d.db")


def test_a_database_with_a_log_is_read_without_writing_into_files_of_other_places(tmp_path, files):
    """SQLite writes into the index of a log, which can have another name elsewhere."""
    (tmp_path / "run").mkdir()
    path, mine = tmp_path / "run" / "database.db", tmp_path / "mine"
    path.write_bytes((files / "database.db").read_bytes())
    path.with_name("database.db-wal").touch()
    assert len(read_database(path, where="x").keypoints) == len(NAMES)
    mine.write_text("mine" * 9000)
    index = path.with_name("database.db-shm")
    for link in (index.hardlink_to, index.symlink_to):
        index.unlink(missing_ok=True)
        link(mine)
        with pytest.raises(UserError, match="^x: "):
            read_database(path, where="x")
        assert mine.read_text() == "mine" * 9000
