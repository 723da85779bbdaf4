"""A work folder has one owner at a time; the log says what changed since the last run."""

import json
import os
import shutil

import pycolmap
import pytest

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.work_folder import open_folder

IDENTITY = {"seed": 0, "version": "1", "images": {"a.jpg": "00", "b.jpg": "11"}}


def test_the_same_run_goes_on_where_it_was(tmp_path):
    out = tmp_path / "deep" / "out"
    with open_folder(out, IDENTITY) as folder:
        (folder.path / "mine").write_text("x")
    with open_folder(out, dict(reversed(IDENTITY.items()))) as folder:
        assert (folder.path / "mine").read_text() == "x"


def test_identity_is_compared_as_json(tmp_path, caplog):
    caplog.set_level("INFO")
    for value in ((1, 2), [1, 2]):
        with open_folder(tmp_path, IDENTITY | {"size": value}):
            pass
    assert "continuing" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 1}, "seed: 0 there, 1 now"),
        ({"version": "2"}, "version: 1 there, 2 now"),
        ({"extra": 5}, "extra: None there, 5 now"),
        ({"images": {"a.jpg": "00", "b.jpg": "22"}}, "1 images, first 'b.jpg'"),
        ({"images": {"b.jpg": "11", "c.jpg": "33"}}, "2 images, first 'a.jpg'"),
    ],
)
def test_what_changed_since_the_last_run_is_said(tmp_path, caplog, change, message):
    caplog.set_level("INFO")
    with open_folder(tmp_path, IDENTITY):
        (tmp_path / "mine").write_text("x")
    with open_folder(tmp_path, {**IDENTITY, **change}):
        assert (tmp_path / "mine").exists()
    assert message in caplog.text and str(tmp_path) in caplog.text
    assert json.loads((tmp_path / "run.json").read_text()) == {**IDENTITY, **change}


def test_a_run_of_other_photos_is_refused(tmp_path):
    with open_folder(tmp_path, IDENTITY):
        pass
    before = (tmp_path / "run.json").read_bytes()
    with pytest.raises(UserError, match="holds a run of other photos .first 'a.jpg'"):
        with open_folder(tmp_path, {**IDENTITY, "images": {"a.jpg": "22", "b.jpg": "33"}}):
            pytest.fail("opened")
    assert (tmp_path / "run.json").read_bytes() == before


@pytest.mark.parametrize("record", ["", "{", "[]", "null", '{"images": []}', "\x00"])
def test_a_damaged_record_is_refused_not_overwritten(tmp_path, record):
    (tmp_path / "run.json").write_text(record)
    with pytest.raises(UserError, match="holds a run whose run.json is damaged"):
        with open_folder(tmp_path, IDENTITY):
            pytest.fail("opened")
    assert (tmp_path / "run.json").read_text() == record


def test_a_second_run_in_the_same_folder_is_refused_until_the_first_ends(tmp_path):
    with open_folder(tmp_path, IDENTITY):
        with pytest.raises(UserError, match="another run is using this folder"):
            with open_folder(tmp_path, IDENTITY):
                pytest.fail("opened")
    with open_folder(tmp_path, IDENTITY):
        pass


def test_a_file_or_a_foreign_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("x")
    for name, message in (
        ("file", "this is a file"),
        ("thesis", "the folder is not empty .*'chapter1.tex'"),
    ):
        with pytest.raises(UserError, match=f"{name}: {message}"):
            with open_folder(tmp_path / name, IDENTITY):
                pytest.fail("opened")
    assert [path.name for path in (tmp_path / "thesis").iterdir()] == ["chapter1.tex"]


def test_an_empty_folder_becomes_a_run(tmp_path):
    with open_folder(tmp_path, IDENTITY):
        assert json.loads((tmp_path / "run.json").read_text()) == IDENTITY


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        with open_folder(tmp_path / "file" / "out", IDENTITY):
            pytest.fail("opened")


@pytest.mark.skipif(
    getattr(os, "geteuid", lambda: 0)() == 0, reason="root and Windows write into such folders"
)
def test_a_read_only_parent_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="cannot be written"):
        with open_folder(tmp_path / "out", IDENTITY):
            pytest.fail("opened")


def test_a_full_disk_is_reported_as_such_and_leaves_no_partial_file(tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, os.strerror(28))

    with open_folder(tmp_path, IDENTITY):
        monkeypatch.setattr(os, "replace", full)
        with pytest.raises(UserError, match="a.json: cannot be written .No space left"):
            write_atomic(tmp_path / "a.json", b"{}")
    assert not list(tmp_path.glob("a.json*"))


@pytest.mark.parametrize("what", ["database", "model"])
def test_what_would_not_fit_on_the_disk_is_refused_before_native_code_begins(
    tmp_path, monkeypatch, what
):
    """On a full disk COLMAP would end the process, or write a model that is cut off."""
    from jaxsfm.colmap.database import write_database
    from jaxsfm.colmap.model_files import write_models

    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=3_000_000))
    with pytest.raises(UserError, match="about 4 MB are needed, 3 MB are left"):
        if what == "database":
            write_database(tmp_path / "database.db", [], {}, Cameras())
        else:
            write_models([pycolmap.Reconstruction()], tmp_path / "sparse")
