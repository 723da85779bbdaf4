"""A run when the machine fails it: what is said, and that nothing is lost.

The table in docs/decisions/reliability.md has a row for each of these tests.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from kept_runs import results
from nursery import Nursery

from jaxsfm.bench.synthetic import write_scene
from jaxsfm.cli.main import UNREAD
from jaxsfm.io.atomic import load_arrays
from jaxsfm.io.entries import PARTIAL
from jaxsfm.io.work_folder import lock_folder

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="the faults are those of Linux"),
]
OPTIONS = ("--preset", "paper", "--refine", "1", "--threads", "1", "--pairs", "exhaustive")
CUT_OFF = 5000
"""Bytes: the figures of a stage are shorter, its model and its database are longer."""


@pytest.fixture(scope="module")
def nursery(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nursery")
    made = Nursery(folder)
    yield made
    made.end()


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    write_scene(folder, num_views=4, size=(192, 144))
    return folder / "images"


def command(photos: Path, out: Path) -> list[str]:
    return ["reconstruct", str(photos), *OPTIONS, "--out", str(out)]


@pytest.fixture(scope="module")
def whole(nursery, photos, tmp_path_factory) -> Path:
    """A run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert nursery.said(command(photos, out), {})[0] == 0
    return out


def said_once(text: str) -> str:
    """The last line, after a check that no error was said in another way, or twice."""
    assert "Traceback" not in text and "stack trace" not in text, text
    lines = [
        line
        for line in text.splitlines()
        if not re.search("continuing|before|compiles|already", line)
    ]
    assert len(lines) == 1 and lines[0].startswith("jaxsfm: "), text
    return lines[0]


def state(folder: Path) -> dict[str, tuple[int, int]]:
    """The size and the time of the last change of each file but the lock."""
    found = {path: path.stat() for path in folder.rglob("*") if path.name != ".lock"}
    return {str(path): (stat.st_size, stat.st_mtime_ns) for path, stat in found.items()}


def check_continued(nursery, photos: Path, out: Path, whole: Path) -> None:
    """The same command goes on to the results that it would have had."""
    status, text = nursery.said(command(photos, out), {})
    assert status == 0, text
    assert results(out) == results(whole)
    assert not list(out.rglob(f"*{PARTIAL}*"))


# -- a full disk ---------------------------------------------------------------------------------

WRITES = [
    ("open", "run.json", 0),
    ("open", "/features/", 0),
    ("open", "/matches/", 0),
    ("os.mkdir", "verified.partial", 0),
    ("os.mkdir", "verified.partial", 20_000),
    ("open", "verified.partial/figures", 0),
    ("open", "verified.partial/key", 0),
    ("os.rename", "verified.partial", 0),
    ("os.mkdir", "mapped.partial", 0),
    ("open", "mapped.partial/database", 20_000),
    ("os.mkdir", "mapped.partial/sparse", CUT_OFF),
    ("os.rename", "mapped.partial", 0),
    ("os.mkdir", "selected.partial/sparse", CUT_OFF),
    ("os.mkdir", "refined.partial/sparse", CUT_OFF),
    ("open", "refined.partial/key", 0),
    ("open", "fresh/database.db", 0),
    ("os.mkdir", "fresh/sparse", CUT_OFF),
    ("open", "fresh/report.json", 0),
    ("open", "fresh/moves.json", 0),
]
"""Where the disk is full from then on, in the order of a run: the event, a part of the path, and
how long a file may still be. A stage's folder is made just before COLMAP writes into it."""


def test_a_disk_that_is_full_at_any_write_is_said_and_the_run_goes_on_later(
    nursery, photos, whole, tmp_path
):
    """One folder goes through all of them, so each failure also meets what the last one left."""
    out = tmp_path / "out"
    for place in WRITES:
        status, text = nursery.said(command(photos, out), {"full": place})
        line = said_once(text)
        assert status == 2, (place, text)
        assert str(out) in line and ("cannot be written" in line or "space" in line), (place, line)
        for file in out.glob("*/*/*.safetensors"):
            assert load_arrays(file) is not None, (place, file)
    check_continued(nursery, photos, out, whole)


def test_a_page_that_the_disk_has_no_room_for_is_only_a_warning(nursery, photos, whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    (out / "report.html").unlink()
    full = {"full": ("open", "report.html", 0)}
    status, text = nursery.said(command(photos, out), full)
    assert status == 0 and f"{out / 'report.html'} was not written" in text
    assert results(out) == results(whole)


def test_space_that_a_quota_does_not_give_is_missed_before_native_code_begins(tmp_path):
    """The disk says that it has room; only an attempt to take it shows that it has not."""
    code = """
import resource, signal, sys
from pathlib import Path
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import check_disk_space
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
check_disk_space(Path(sys.argv[1]), 100_000)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, resource.RLIM_INFINITY))
try:
    check_disk_space(Path(sys.argv[1]), 100_000)
except UserError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"{tmp_path}: cannot be written (File too large)"
    assert list(tmp_path.iterdir()) == []


# -- a folder that cannot be written -------------------------------------------------------------


def test_a_read_only_folder_is_refused_and_stays_as_it_is(nursery, photos, whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    paths = [out, *out.rglob("*")]
    for path in paths:
        path.chmod(0o500 if path.is_dir() else 0o400)
    before = state(out)
    try:
        for target in (out, out / "new"):
            status, text = nursery.said(command(photos, target), {"plain": True})
            assert status == 2
            assert said_once(text) == (
                f"jaxsfm: --out {target}: cannot be written (Permission denied)"
            )
        status, text = nursery.said(["report", str(out)], {"plain": True})
        assert status == 2 and "report.html: cannot be written" in said_once(text)
        assert state(out) == before
    finally:
        for path in paths:
            path.chmod(0o700)


def test_photos_that_cannot_be_written_are_read_all_the_same(nursery, photos, tmp_path):
    own = tmp_path / "images"
    shutil.copytree(photos, own)
    own.chmod(0o500)
    try:
        pairs = ["pairs", str(own), "--pairs", "exhaustive", "--out", str(tmp_path / "p.txt")]
        assert nursery.said(pairs, {"plain": True})[0] == 0
    finally:
        own.chmod(0o700)


# -- a photo that is removed ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("when", "usable", "word"),
    [
        (("open", ".lock"), 3, "skipped          view1.png: cannot be read"),
        (("open", "/matches/"), 4, "no refinement: view1.png: cannot be read"),
        (("os.mkdir", "refined.partial"), 4, "no refinement: view1.png: cannot be read"),
    ],
    ids=["before it is described", "before it is matched", "before it is refined"],
)
def test_a_photo_that_is_removed_during_the_run_is_named_and_the_run_goes_on(
    nursery, photos, whole, tmp_path, when, usable, word
):
    own, out = tmp_path / "images", tmp_path / "out"
    shutil.copytree(photos, own)
    gone = own / "view1.png"
    status, text = nursery.said(command(own, out), {"remove": [*when, str(gone)]})
    assert status == 0 and not gone.exists()
    assert word in text
    report = json.loads((out / "report.json").read_text())
    assert report["images"]["usable"] == usable == report["models"][0]["registered"]
    # It is back: the run makes up for what it could not do.
    shutil.copyfile(photos / "view1.png", gone)
    assert nursery.said(command(own, out), {})[0] == 0
    for name in ("images.bin", "points3D.bin"):
        one, two = (folder / "sparse" / "0" / name for folder in (out, whole))
        assert one.read_bytes() == two.read_bytes()


# -- two runs ------------------------------------------------------------------------------------


def test_a_second_run_in_one_folder_is_refused_and_changes_nothing(
    nursery, photos, whole, tmp_path
):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    with lock_folder(out):
        before = state(out)
        for argv in (command(photos, out), ["extend", str(out)]):
            status, text = nursery.said(argv, {})
            assert status == 2, text
            assert said_once(text) == f"jaxsfm: --out {out}: another run is using this folder"
        assert state(out) == before
    check_continued(nursery, photos, out, whole)


# -- an end from outside -------------------------------------------------------------------------

STAGES = [
    ("open", ".lock"),
    ("open", "/features/"),
    ("open", "/matches/"),
    ("os.mkdir", "verified.partial"),
    ("os.mkdir", "mapped.partial"),
    ("os.mkdir", "mapped.partial/sparse"),
    ("os.mkdir", "selected.partial"),
    ("os.mkdir", "refined.partial"),
    ("open", "fresh/database.db"),
    ("open", "fresh/moves.json"),
    ("os.rename", "/publishing/database.db"),
    ("os.rename", "/publishing/report.json"),
    ("open", "report.html"),
]


def test_sigterm_in_any_stage_ends_the_run_in_a_sentence_and_it_goes_on_later(
    nursery, photos, whole, tmp_path
):
    """In native code as well: `test_interruption.py`. No process is left, says the nursery."""
    out, kept = tmp_path / "out", dict[str, int]()
    for place in STAGES:
        status, text = nursery.said(command(photos, out), {"signal": [*place, signal.SIGTERM]})
        assert status == 130, (place, status, text)
        assert "interrupted" in text.splitlines()[-1] and "Traceback" not in text, text
        made = {path.parent.name: path.stat().st_mtime_ns for path in out.glob("stages/*/key")}
        assert {stage: made.get(stage) for stage in kept} == kept, "a stage was lost or repeated"
        kept = made
    assert kept.keys() == {"verified", "mapped", "selected", "refined"}
    check_continued(nursery, photos, out, whole)


# -- nobody reads what is printed ----------------------------------------------------------------


@pytest.mark.parametrize("unread", [(1,), (2,), (1, 2)], ids=["stdout", "stderr", "both"])
def test_a_run_whose_output_nobody_reads_ends_without_a_word_and_loses_nothing(
    nursery, photos, whole, tmp_path, unread
):
    out = tmp_path / "out"
    status, text = nursery.said(command(photos, out), {"unread": unread})
    assert status == UNREAD and "roken pipe" not in text and "Traceback" not in text
    if unread == (1,):  # only the summary comes there, when all else is done
        assert results(out) == results(whole)
    check_continued(nursery, photos, out, whole)


@pytest.mark.parametrize(
    ("argv", "unread"),
    [
        (["--version"], [1]),
        (["--help"], [1]),
        (["bench", "ledger", "--help"], [1, 2]),
        (["report", "nowhere"], [2]),
    ],
)
def test_head_may_close_the_pipe_of_any_command(nursery, argv, unread):
    assert nursery.said(argv, {"unread": unread}) == (UNREAD, "")


# -- little memory -------------------------------------------------------------------------------


DECODE = """
import resource, sys
from pathlib import Path
from jaxsfm.io.images import DamagedImage, ImageError, inspect_image, read_image
photo = inspect_image(Path(sys.argv[1]), name="huge.png")
pages = int(Path("/proc/self/statm").read_text().split()[0])
most = pages * resource.getpagesize() + (100 << 20)
resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
try:
    read_image(photo, max_size=192)
except ImageError as error:
    print(isinstance(error, DamagedImage), error)
"""


def test_a_photo_that_does_not_fit_into_memory_is_not_taken_for_a_damaged_one(tmp_path):
    """A damaged photo is remembered, and later runs skip it, however much memory they have."""
    huge = tmp_path / "huge.png"
    assert cv2.imwrite(str(huge), np.zeros((8000, 8000), np.uint8))
    done = subprocess.run(
        [sys.executable, "-c", DECODE, str(huge)], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False huge.png: there is not enough memory to decode it"


@pytest.mark.parametrize("room", [20, 120, 400], ids="{} MiB".format)
def test_too_little_memory_is_said_and_nothing_is_lost(nursery, photos, whole, tmp_path, room):
    """Where XLA or LLVM ends the process by itself (SIGABRT), the run goes on all the same."""
    out = tmp_path / "out"
    status, text = nursery.said(command(photos, out), {"memory": room << 20})
    assert status in (1, 2, -signal.SIGABRT), text
    if status > 0:
        assert "memory" in said_once(text)
    check_continued(nursery, photos, out, whole)


# -- no home, no locale --------------------------------------------------------------------------


def ran(argv: list[str], **variables: str | None) -> subprocess.CompletedProcess[str]:
    """A command in an environment with these variables; None: without this one."""
    kept = {"JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME", "LANG"} | variables.keys()
    base = {name: value for name, value in os.environ.items() if name not in kept}
    given = {name: value for name, value in variables.items() if value is not None}
    code = [sys.executable, "-m", "jaxsfm.cli.main", *argv]
    return subprocess.run(
        code, capture_output=True, text=True, env=base | given, encoding="utf-8", errors="replace"
    )


@pytest.mark.parametrize("home", [None, "/dev/null/nowhere"], ids=["none", "not a folder"])
def test_without_a_home_a_command_works(photos, tmp_path, home):
    both = [str(photos / f"view{k}.png") for k in (0, 1)]
    small = ["--preset", "paper", "--max-size", "96", "--out", str(tmp_path / "m.npz")]
    done = ran(["match", *both, *small], HOME=home)
    assert done.returncode == 0 and (tmp_path / "m.npz").exists(), done.stderr
    assert "Traceback" not in done.stderr and "UserWarning" not in done.stderr
    said = [line for line in done.stderr.splitlines() if "compiles its programs" in line]
    if home is not None:
        assert len(said) == 1 and f"cannot be kept in {home}" in said[0]


UTF8_NAMES = ("größe.png", "Ärger 1.png", "写真.png")


@pytest.mark.parametrize("variables", [{"LC_ALL": "C"}, {"LC_ALL": "POSIX", "LANG": "nonsense"}])
def test_without_a_locale_names_of_photos_are_what_they_are(photos, tmp_path, variables):
    own = tmp_path / "Müller"
    own.mkdir()
    for number, name in enumerate(UTF8_NAMES):
        shutil.copyfile(sorted(photos.iterdir())[number], own / name)
    listed = tmp_path / "páry.txt"
    done = ran(["pairs", str(own), "--pairs", "exhaustive", "--out", str(listed)], **variables)
    assert done.returncode == 0, done.stderr
    text = listed.read_text(encoding="utf-8")
    assert all(name in text for name in UTF8_NAMES)
    assert "páry.txt" in done.stdout or "p\\xe1ry.txt" in done.stdout


def test_names_that_python_reads_in_another_encoding_are_refused_with_what_helps(photos, tmp_path):
    for number, name in enumerate(UTF8_NAMES[:2]):
        shutil.copyfile(sorted(photos.iterdir())[number], tmp_path / name)
    variables = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    pairs = ["pairs", str(tmp_path), "--pairs", "exhaustive", "--out", str(tmp_path / "p.txt")]
    done = ran(pairs, **variables)
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
    assert "PYTHONUTF8=1" in done.stderr and "not UTF-8, which COLMAP" not in done.stderr


# -- many photos ---------------------------------------------------------------------------------

MANY, MOST_SECONDS, MOST_BYTES = 10_000, 300, 2 << 30


def test_ten_thousand_tiny_photos_are_looked_through_in_minutes(nursery, tmp_path):
    """Until the first photo is described. The run is stopped there."""
    own, out = tmp_path / "images", tmp_path / "out"
    own.mkdir()
    rng = np.random.default_rng(0)
    for number in range(MANY):
        small = rng.integers(0, 256, (64, 64, 3), np.uint8)
        (own / f"{number:05}.jpg").write_bytes(cv2.imencode(".jpg", small)[1].tobytes())
    stop = {"signal": ["open", "/descriptors/", signal.SIGTERM], "usage": True}
    argv = ["reconstruct", str(own), "--out", str(out), "--threads", "1"]
    status, text = nursery.said(argv, stop)
    assert status == 130, text
    found = re.search(r"usage: ([0-9.]+) s, ([0-9]+) bytes", text)
    assert found, text
    print(found.group(0))
    assert float(found[1]) < MOST_SECONDS and int(found[2]) < MOST_BYTES
