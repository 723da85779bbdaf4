"""A work folder from a stranger: no command writes, moves or deletes anything outside of it."""

import json
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import pytest
from kept_runs import renamed

from jaxsfm.cli.main import main
from jaxsfm.io.entries import ENTRIES, FRAMES, PARTIAL, remove
from jaxsfm.report.run_report import RunReport

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_written: list[str] | None = None


def _note(event: str, args: tuple) -> None:
    """An audit hook: Python calls it before it touches a file, and it stays for ever."""
    if _written is None:
        return
    if event == "open" and isinstance(args[0], str | bytes) and args[2] & _WRITING:
        _written.append(os.fsdecode(args[0]))
    elif event in ("os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree") and args[-1] in (-1, None):
        _written.append(os.fsdecode(args[0]))
    elif event in ("os.rename", "os.link", "os.symlink"):
        _written.extend(os.fsdecode(each) for each in args[:2])


sys.addaudithook(_note)


@contextmanager
def noted() -> Iterator[list[str]]:
    """The paths that are written, moved or deleted in the block."""
    global _written
    _written = []
    try:
        yield _written
    finally:
        _written = None


def reconstruct(scene: Path, out: Path, *more: str) -> int:
    known = ["--intrinsics", str(scene / "K.txt"), "--threads", "1"]
    return main(["reconstruct", str(scene / "images"), "--out", str(out), *known, *more])


def state(folder: Path) -> dict[str, bytes | str]:
    """All that is below a folder."""
    found: dict[str, bytes | str] = {}
    for root, folders, files in os.walk(folder):
        for path in (Path(root) / name for name in (*folders, *files)):
            plain = path.is_file() and not path.is_symlink()
            found[str(path.relative_to(folder))] = path.read_bytes() if plain else os.fspath(path)
    return found


def test_all_that_commands_write_is_in_the_table_of_entries(plain, scene, tmp_path):
    """Whoever adds an entry has to name it there, and then all tests of links know it."""
    out = tmp_path / "out"
    shutil.copytree(plain[0], out)
    next(out.glob("matches/*/*")).unlink()
    shutil.rmtree(out / "stages" / "refined")
    photo = str(scene / "images" / "view0.png")
    with noted() as written:
        assert reconstruct(scene, out, "--keep-features") == 0
        assert main(["localize", photo, "--model", str(out), "--shortlist", "1"]) == 0
        assert main(["extend", str(out)]) == 0
        assert main(["report", str(out)]) == 0
    below = {Path(path).relative_to(out).parts for path in written if path.startswith(str(out))}
    first = {parts[0] for parts in below if parts}
    assert {"features", "matches", "descriptors", "stages", "fresh", "sparse"} <= first
    made = {path.name for path in out.iterdir()}
    assert {name for name in first | made if not name.endswith(PARTIAL)} <= ENTRIES


@pytest.mark.parametrize("name", sorted(ENTRIES - {FRAMES}))
def test_no_command_that_changes_a_run_follows_a_link_to_another_one(
    plain, scene, tmp_path, capsys, name
):
    out, other = tmp_path / "out", tmp_path / "other"
    for folder in (out, other):
        shutil.copytree(plain[0], folder)
    if not (other / name).exists():
        (other / name).mkdir()
    remove(out / name)
    (out / name).symlink_to(other / name)
    before = state(other)
    for command in (lambda: reconstruct(scene, out), lambda: main(["extend", str(out)])):
        assert command() == 2
        assert f"{out / name}: " in capsys.readouterr().err
        assert state(other) == before


def test_commands_that_only_read_a_run_write_through_no_link(plain, scene, tmp_path):
    """A link may lead to what is read, so these commands need not refuse it."""
    out, other = tmp_path / "out", tmp_path / "other"
    for folder in (out, other, other / "failed"):
        shutil.copytree(plain[0], folder)
    for name in ("matches", "features", "descriptors", "failed", "unusable.json", "report.html"):
        if not (other / name).exists():
            (other / name).mkdir()
        remove(out / name)
        (out / name).symlink_to(other / name)
    before = state(other)
    photo = str(scene / "images" / "view0.png")
    assert main(["localize", photo, "--model", str(out), "--shortlist", "1"]) in (0, 1)
    keep = ["--shortlist", "1", "--keep-features"]
    assert main(["localize", photo, "--model", str(out), *keep]) == 2
    assert main(["report", str(out)]) == 0
    assert main(["report", str(out / "failed")]) == 2
    assert state(other) == before


@pytest.mark.parametrize("kind", ["relative", "absolute", "drive", "share"])
def test_no_path_in_a_report_leads_a_command_to_other_files(plain, scene, tmp_path, kind, capsys):
    out, outside = tmp_path / "out", tmp_path / "outside"
    shutil.copytree(plain[0], out)
    outside.mkdir()
    (outside / "file").write_text("mine")
    path = {
        "relative": "../outside/file",
        "absolute": str(outside / "file"),
        "drive": "C:\\outside\\file",
        "share": "\\\\server\\share\\file",
    }[kind]
    report = json.loads((out / "report.json").read_text())
    count = _put_paths(report, report, path)
    assert count > 20
    (out / "report.json").write_text(json.dumps(report))
    before = state(outside)
    photo = str(scene / "images" / "view0.png")
    images = ["--images", str(scene / "images")]
    for args in (
        ["report", str(out)],
        ["report", str(out), *images],
        ["extend", str(out), *images],
        ["localize", photo, "--model", str(out), *images],
        *(
            ["export", str(out), *images, "--to", to, "--out", str(tmp_path / "new" / to)]
            for to in ("hloc", "nerfstudio", "undistorted")
        ),
    ):
        assert main(args) in (0, 2), args
    assert state(outside) == before
    assert {path.name for path in tmp_path.iterdir()} <= {"out", "outside", "new"}


def _put_paths(report: object, part: object, path: str) -> int:
    """Put a path into the place of every string with which the report can still be read."""
    count = 0
    keys = part.keys() if isinstance(part, dict) else range(len(part))  # type: ignore[arg-type]
    for key in list(keys):
        value = part[key]  # type: ignore[index]
        if isinstance(value, dict | list):
            count += _put_paths(report, value, path)
        elif isinstance(value, str):
            part[key] = path  # type: ignore[index]
            try:
                RunReport.from_json(report)
                count += 1
            except msgspec.ValidationError:
                part[key] = value  # type: ignore[index]
    return count


def test_no_name_of_a_photo_leads_a_command_to_other_files(plain, scene, tmp_path):
    """Photos are read where a name leads, as COLMAP does. Nothing is written there."""
    run, photos = renamed(plain[0], scene / "images", tmp_path, "view0.png", "../view0.png")
    with closing(sqlite3.connect(run / "database.db")) as db:
        db.execute("UPDATE images SET name = '../view0.png' WHERE name = 'view0.png'")
        db.commit()
    before = state(tmp_path)
    images = ["--images", str(photos)]
    for to in ("hloc", "colmap", "colmap-text", "ply", "nerfstudio", "undistorted"):
        place = tmp_path / "run" / "new" / (f"{to}.ply" if to == "ply" else to)
        place.parent.mkdir(exist_ok=True)
        copied = ["--copy-images"] if to == "nerfstudio" else []
        main(["export", str(run), "--to", to, "--out", str(place), *images, *copied])
    main(["report", str(run), *images])
    main(["extend", str(run), *images])
    refined = ["--images", str(photos), "--out", str(run / "new" / "refined")]
    main(["refine", str(run / "sparse" / "0"), *refined])
    after = state(tmp_path)
    changed = {name for name in before | after if before.get(name) != after.get(name)}
    assert not [name for name in changed if not name.startswith("run/")]
