"""What lies in a work folder does not decide what is written, moved or deleted outside of it."""

import contextlib
import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from test_work_folder import IDENTITY, PAIRS, features, result

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import atomic_folder, write_atomic
from jaxsfm.io.entries import ENTRIES, FRAMES, LOGS, RECORD, RESULTS, entry, named_place, remove
from jaxsfm.io.images import DamagedImage
from jaxsfm.io.work_folder import WorkFolder, open_folder

KINDS = ("file", "folder", "missing", "other run")


def live(out: Path) -> None:
    """Do everything that runs do to their work folder: one with a model, and one without."""
    with open_folder(out, IDENTITY) as folder:
        photo = features()
        folder.save_features(photo)
        folder.save_matches(result(PAIRS[0]))
        folder.save_descriptor(photo.image, "gem", np.ones(3))
        folder.record_failure(photo.image, DamagedImage("torn"))
        for name in ("verified", "mapped"):
            open_database(folder.stage(name, "key", write_stage))
        folder.forget_stage("mapped")
        for names in (RESULTS[:2], RESULTS, RESULTS[:2]):
            with folder.publish() as fresh:
                write_results(fresh, names)
        folder.drop_features()


def write_stage(fresh: Path) -> None:
    open_database(fresh)
    (fresh / "sparse").mkdir()
    (fresh / "sparse" / "points3D.bin").write_text("new")


def open_database(folder: Path) -> None:
    """Open a database as COLMAP does, which writes into its header."""
    with contextlib.closing(sqlite3.connect(folder / "database.db")) as db:
        (version,) = db.execute("PRAGMA user_version").fetchone()
        db.execute(f"PRAGMA user_version = {version + 1}")


def write_results(folder: Path, names: Iterable[str] = RESULTS) -> None:
    for name in names:
        if "." in name:
            (folder / name).write_text("new")
        else:
            (folder / name / "0").mkdir(parents=True)
            (folder / name / "0" / "points3D.bin").write_text("new")


def interrupt_publishing(out: Path) -> None:
    """Leave what a run leaves that is killed before its results are in their places."""
    (out / "publishing").mkdir(exist_ok=True)
    write_results(out / "publishing")
    moves = {"failed": False, "names": list(RESULTS)}
    (out / "publishing" / "moves.json").write_text(json.dumps(moves))


def state(folder: Path) -> dict[str, bytes | str]:
    """All that is below a folder."""
    found: dict[str, bytes | str] = {}
    for root, folders, files in os.walk(folder):
        for path in (Path(root) / name for name in (*folders, *files)):
            plain = path.is_file() and not path.is_symlink()
            found[str(path.relative_to(folder))] = path.read_bytes() if plain else os.fspath(path)
    return found


@pytest.fixture(scope="module")
def lived(tmp_path_factory) -> Path:
    """A work folder in which there is something of every entry."""
    out = tmp_path_factory.mktemp("lived") / "out"
    live(out)
    interrupt_publishing(out)
    for name in ENTRIES - {path.name for path in out.iterdir()}:
        if "." in name and not name.startswith(FRAMES):
            (out / name).write_text("x")
        else:
            (out / name / "ab").mkdir(parents=True)
            (out / name / "ab" / "cd.json.9.partial").write_text("x")
    return out


def places(lived: Path) -> list[str]:
    """All that is in a work folder, but nothing below the photos of a video."""
    every = sorted(path.relative_to(lived).as_posix() for path in lived.rglob("*"))
    return [name for name in every if not name.startswith((f"{FRAMES}/", f"{FRAMES}.partial/"))]


@pytest.fixture
def attack(lived, tmp_path) -> Callable[..., UserError | None]:
    """A function that puts something into a copy of the folder and lets a run live in it.

    The function returns the refusal of the run, if there was one. Nothing outside may have changed.
    """
    outside, out = tmp_path / "outside", tmp_path / "out"
    shutil.copytree(lived, outside / "other run")
    shutil.copytree(lived, outside / "folder")
    shutil.copytree(lived / "publishing", outside / "folder", dirs_exist_ok=True)
    (outside / "file").write_text("mine")
    before = state(outside)

    def attacked(put: Callable[[Path, Path], None]) -> UserError | None:
        shutil.copytree(lived, out)
        put(out, outside)
        refusal: UserError | OSError | None = None
        try:
            live(out)
        except (UserError, OSError) as error:
            refusal = error
        assert state(outside) == before
        assert not isinstance(refusal, OSError), refusal
        shutil.rmtree(out)
        return refusal

    return attacked


def test_the_table_names_every_entry_and_the_tests_put_something_into_each(lived):
    assert {path.name for path in lived.iterdir()} == ENTRIES
    assert len(places(lived)) > 2 * len(ENTRIES)


@pytest.mark.parametrize("kind", KINDS)
def test_a_link_at_any_place_leads_no_run_to_other_files(lived, attack, kind):
    for place in places(lived):

        def put(out: Path, outside: Path, place: str = place) -> None:
            remove(out / place)
            (out / place).symlink_to(outside / kind / (place if kind == "other run" else ""))

        refusal = attack(put)
        if not place.startswith(FRAMES):  # those are photos, and only read
            assert refusal is not None, place
            assert f"out/{place}: " in str(refusal) or place == RECORD


def test_results_of_an_interrupted_run_without_a_model_go_into_no_other_run(attack):
    def put(out: Path, outside: Path) -> None:
        moves = {"failed": True, "names": list(RESULTS)}
        (out / "publishing" / "moves.json").write_text(json.dumps(moves))
        remove(out / "failed")
        (out / "failed").symlink_to(outside / "other run")

    assert "out/failed: " in str(attack(put))


def test_another_name_of_a_file_outside_is_not_written_through(lived, attack):
    """A hard link cannot be told from a file, and copies of a work folder may share files."""
    for place in places(lived):
        if (lived / place).is_file():

            def put(out: Path, outside: Path, place: str = place) -> None:
                remove(out / place)
                os.link(outside / "other run" / place, out / place)

            assert attack(put) is None, place

    def put_lock(out: Path, outside: Path) -> None:
        remove(out / ".lock")
        os.link(outside / "file", out / ".lock")

    assert "not the lock" in str(attack(put_lock))


def test_a_link_that_is_put_there_during_a_run_is_not_followed(lived, tmp_path):
    """Each method of the folder looks again."""
    steps: list[Callable[[WorkFolder], object]] = [
        lambda folder: folder.save_features(features()),
        lambda folder: folder.save_matches(result(PAIRS[0])),
        lambda folder: folder.save_descriptor(features().image, "gem", np.ones(3)),
        lambda folder: folder.record_failure(features().image, DamagedImage("torn")),
        lambda folder: folder.stage("mapped", "other", write_stage),
        lambda folder: folder.forget_stage("mapped"),
        lambda folder: folder.publish().__enter__(),
        lambda folder: folder.finish_publishing(),
        lambda folder: folder.drop_features(),
        lambda folder: folder.sweep(),
    ]
    outside, refused = tmp_path / "outside", 0
    shutil.copytree(lived, outside)
    before = state(outside)
    for name in sorted(ENTRIES):
        out = tmp_path / name
        shutil.copytree(lived, out)
        for step in steps:
            remove(out / name)
            (out / name).symlink_to(outside / name)
            try:
                step(WorkFolder(out, IDENTITY))
            except UserError:
                refused += 1
        assert state(outside) == before, name
    assert refused > 10


def test_a_log_of_a_database_is_not_played_back(lived, attack):
    """SQLite deletes the file that a journal names as that of all databases of a transaction."""

    def put(out: Path, outside: Path) -> None:
        def with_journal(fresh: Path) -> None:
            write_stage(fresh)
            _plant(fresh / "database.db", outside / "file")

        _keep(out, with_journal)

    assert attack(put) is None


def test_a_database_with_two_names_is_copied_and_not_over_another_file(attack, tmp_path):
    def put(out: Path, outside: Path) -> None:
        def with_names(fresh: Path) -> None:
            write_stage(fresh)
            os.link(fresh / "database.db", tmp_path / "second name")
            os.link(outside / "file", fresh / "database.db.partial")

        _keep(out, with_names)

    assert attack(put) is None


def _keep(out: Path, compute: Callable[[Path], None]) -> None:
    """Let a stage be found that something else has computed."""
    with open_folder(out, IDENTITY) as folder:
        key = folder.stage("verified", "other", compute) / "key"
    key.write_text(key.read_text().replace("other", "key"))


def _plant(database: Path, victim: Path) -> None:
    """Write a journal that names a victim: https://www.sqlite.org/fileformat2.html#the_rollback_journal"""
    magic, page = bytes.fromhex("d9d505f920a163d7"), 4096
    numbers = (0, 1, database.stat().st_size // page, 512, page)
    head = magic + b"".join(n.to_bytes(4, "big") for n in numbers)
    name = str(victim).encode()
    tail = (len(name), sum(name))
    journal = head.ljust(512, b"\0") + (2**30 // page + 1).to_bytes(4, "big") + name
    journal += b"".join(n.to_bytes(4, "big") for n in tail) + magic
    database.with_name(f"{database.name}-journal").write_bytes(journal)


def test_new_results_are_not_read_with_the_logs_of_old_ones(lived, tmp_path):
    shutil.copytree(lived, tmp_path / "out")
    live(tmp_path / "out")
    assert not [end for end in LOGS if (tmp_path / "out" / f"database.db{end}").exists()]


def hostile(outside: Path) -> Iterator[str]:
    """Paths to a file outside of the folder."""
    yield "../outside/file"
    yield str(outside / "file")
    yield f"C:\\{outside}\\file"
    yield "\\\\server\\share\\file"


def test_no_path_in_a_file_leads_a_run_to_other_files(lived, attack):
    files = [p for p in places(lived) if p.endswith((".json", "/key"))]
    assert {"publishing/moves.json", "run.json", "unusable.json"} <= {*files}
    for place in files:
        for k in range(4):

            def put(out: Path, outside: Path, place: str = place, k: int = k) -> None:
                path = [*hostile(outside)][k]
                if place.endswith(".json") and (out / place).read_text() not in ("new", "x"):
                    old = json.loads((out / place).read_text())
                    (out / place).write_text(json.dumps(_with_paths(old, path)))
                else:
                    (out / place).write_text(path)

            attack(put)


def _with_paths(value: object, path: str) -> object:
    """JSON with a path in the place of every string."""
    if isinstance(value, dict):
        return {key: _with_paths(each, path) for key, each in value.items()} | {path: path}
    if isinstance(value, list):
        return [_with_paths(each, path) for each in value]
    return path if isinstance(value, str) else value


@pytest.mark.parametrize("name", ["other.json", "", "..", "../out", "/", "sparse/0"])
def test_only_names_of_the_table_are_entries(tmp_path, name):
    with pytest.raises(ValueError, match="ENTRIES"):
        entry(tmp_path, name)


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", "/x", "C:x", "C:\\x", "a\\b"])
def test_no_name_below_an_entry_has_a_folder_in_it(tmp_path, name):
    with pytest.raises(ValueError, match="folder in it"):
        entry(tmp_path, "stages", name)


def test_a_folder_that_is_a_link_or_lies_behind_one_is_used(lived, tmp_path):
    shutil.copytree(lived, tmp_path / "disk" / "out")
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    (tmp_path / "own").symlink_to(tmp_path / "link" / "out")
    live(tmp_path / "link" / "out")
    live(tmp_path / "own")
    assert (tmp_path / "own").is_symlink() and named_place(tmp_path / "own").name == "out"


def test_links_to_photos_are_left_alone(lived, tmp_path):
    """A user may have put links beside the results, and among the frames of a video."""
    out, photos = tmp_path / "out", tmp_path / "photos"
    shutil.copytree(lived, out)
    photos.mkdir()
    (photos / "a.png").write_text("photo")
    for name in ("images", "frames/more", "sparse images"):
        (out / name).symlink_to(photos)
    live(out)
    assert all((out / name / "a.png").exists() for name in ("images", "frames/more"))


def test_a_place_that_a_user_names_is_not_reached_through_a_link_in_a_work_folder(lived, tmp_path):
    shutil.copytree(lived, tmp_path / "out")
    (tmp_path / "out" / "exports").symlink_to(tmp_path)
    for path in (tmp_path / "out" / "exports", tmp_path / "out" / "exports" / "new"):
        with pytest.raises(UserError, match="out/exports"):
            named_place(path)
    assert named_place(tmp_path / "out" / "new") == tmp_path / "out" / "new"
    own = tmp_path / "out" / "exports" / ".." / "new"
    with pytest.raises(UserError, match="out/exports"):
        named_place(own)


def test_of_a_link_only_the_link_is_replaced(tmp_path):
    """Wherever something is written whole, and whatever its partial name is."""
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").write_text("mine")
    for name in ("a.json", f"a.json.{os.getpid()}.partial"):
        (tmp_path / name).symlink_to(tmp_path / "mine")
    for name in ("made", "made.partial"):
        (tmp_path / name).symlink_to(tmp_path / "folder")
    write_atomic(tmp_path / "a.json", b"new")
    with atomic_folder(tmp_path / "made") as fresh:
        (fresh / "mine").write_text("new")
    assert (tmp_path / "mine").read_text() == (tmp_path / "folder" / "mine").read_text() == "mine"
    assert (tmp_path / "a.json").read_text() == (tmp_path / "made" / "mine").read_text() == "new"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "folder", "made", "mine"]
