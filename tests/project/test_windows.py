"""The package needs nothing that Windows lacks, and obeys Windows's laws for files.

Nothing here runs on Windows. A process on Linux hides what Windows lacks from our packages, and
refuses what Windows refuses (`posix_only`).
"""

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath

import pytest
from local_server import CONTENT, url
from posix_only import MODULES, OURS, forbidden_names, windows_lacks

from jaxsfm.colmap.formats.tables import leads_out

ROOT = Path(__file__).parents[2]
SOURCES = sorted(path for package in OURS for path in (ROOT / package).rglob("*.py"))
ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells what is open")


def _nodes(tree: ast.AST, skip_guarded: bool = False) -> Iterator[ast.AST]:
    """The nodes of a module, without those below `if sys.platform == ...` if wanted."""
    for child in ast.iter_child_nodes(tree):
        if skip_guarded and isinstance(child, ast.If) and "sys.platform" in ast.unparse(child.test):
            continue
        yield child
        yield from _nodes(child, skip_guarded)


def posix_only_names(code: str) -> list[str]:
    """The modules and names in a module's code that Windows lacks."""
    found = []
    for node in _nodes(ast.parse(code), skip_guarded=True):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.partition(".")[0] in MODULES]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            if node.module.partition(".")[0] in MODULES:
                found.append(node.module)
            found += [a.name for a in node.names if windows_lacks(node.module, a.name)]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if windows_lacks(node.value.id, node.attr):
                found.append(ast.unparse(node))
    return found


def without_encoding(code: str) -> list[str]:
    """The calls in a module's code that read or write text in the system's own encoding."""
    found = []
    for node in _nodes(ast.parse(code)):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        modes = [a.value for a in node.args if isinstance(a, ast.Constant)]
        text = name == "open" and any(m in ("r", "w", "a", "x", "rt", "wt") for m in modes)
        bare_open = isinstance(node.func, ast.Name) and name == "open" and len(node.args) == 1
        if name in ("read_text", "write_text") or text or bare_open:
            if not any(k.arg in ("encoding", "mode", None) for k in node.keywords):
                # COLMAP's Reconstruction.write_text takes a folder alone.
                if ast.unparse(node) != "model.write_text(fresh)":
                    found.append(ast.unparse(node))
    return found


def test_no_module_imports_or_uses_what_windows_lacks():
    assert len(SOURCES) > 150
    found = {str(path): posix_only_names(path.read_text("utf-8")) for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


def test_text_files_say_their_encoding():
    """Windows's own encoding is not UTF-8."""
    found = {str(path): without_encoding(path.read_text("utf-8")) for path in SOURCES}
    assert {path: calls for path, calls in found.items() if calls} == {}


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import fcntl", ["fcntl"]),
        ("def f():\n    from resource import getrusage", ["resource"]),
        ("import os\nos.sysconf('SC_PAGE_SIZE')", ["os.sysconf"]),
        ("import os\nlen(os.sched_getaffinity(0))", ["os.sched_getaffinity"]),
        ("from os import fork, getpid", ["fork"]),
        ("import signal\nsignal.signal(signal.SIGKILL, f)", ["signal.SIGKILL"]),
        ("import os, signal\nos.replace(a, b), os.cpu_count(), os.O_RDONLY, signal.SIGINT", []),
        ("if sys.platform == 'linux':\n    os.sched_getaffinity(0)\nelse:\n    f()", []),
    ],
)
def test_what_windows_lacks_is_found_in_code(code, found):
    assert posix_only_names(code) == found


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("path.read_text()", True),
        ("path.write_text(text)", True),
        ("open('a')", True),
        ("path.open('w')", True),
        ("path.read_text(encoding='ascii')", False),
        ("path.open('rb')", False),
        ("path.open('w', encoding='utf-8', newline='')", False),
    ],
)
def test_text_without_an_encoding_is_found_in_code(code, found):
    assert bool(without_encoding(code)) == found


@pytest.mark.parametrize(
    ("name", "posix", "windows"),
    [
        ("a/b.jpg", False, False),
        ("a/..b.jpg", False, False),
        ("../b.jpg", True, True),
        ("a/../../b.jpg", True, True),
        ("/b.jpg", True, True),
        ("..\\b.jpg", False, True),
        ("C:\\b.jpg", False, True),
        ("C:b.jpg", False, True),
        ("\\b.jpg", False, True),
        ("\\\\host\\share\\b.jpg", False, True),
    ],
)
def test_a_name_that_leads_out_of_a_folder_is_found_by_the_laws_of_each_system(
    name, posix, windows
):
    assert leads_out(name, PurePosixPath) == posix
    assert leads_out(name, PureWindowsPath) == windows


def as_on_windows(code: str, folder: Path, *args: str) -> str:
    """Run code in a process that behaves like Windows; its output."""
    begin = "import posix_only\nposix_only.behave_like_windows()\n"
    path = os.pathsep.join([str(ROOT / "tests"), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-c", begin + code, str(folder), *args],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    return done.stdout


@ON_LINUX
def test_the_laws_are_in_force(tmp_path):
    """Also for files that native code has open or mapped."""
    code = """
import mmap, os, shutil, sqlite3, sys
from pathlib import Path
import numpy as np
folder = Path(sys.argv[1])
def refusals(act):
    before = len(posix_only.refused)
    try:
        act()
    except OSError:
        pass
    return len(posix_only.refused) - before
(folder / "sub").mkdir()
(folder / "empty").mkdir()
(folder / "sub" / "a").write_bytes(b"abc")
(folder / "b").write_bytes(b"abc")
file = (folder / "sub" / "a").open("rb")
assert refusals(lambda: os.replace(folder / "b", folder / "sub" / "a")) == 1
assert refusals((folder / "sub" / "a").unlink) == 1
assert refusals(lambda: (folder / "sub").rename(folder / "moved")) == 1
assert refusals(lambda: shutil.rmtree(folder / "sub", ignore_errors=True)) >= 1
mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
file.close()
assert refusals((folder / "sub" / "a").unlink) == 1
mapped.close()
assert refusals(lambda: (folder / "sub").replace(folder / "empty")) == 1
assert refusals(lambda: (folder / "b").rename(folder / "sub" / "a")) == 1
assert refusals(lambda: (folder / "b").replace(folder / "sub" / "a")) == 0
db = sqlite3.connect(folder / "c.db")
db.execute("create table t (x)")
assert refusals((folder / "c.db").unlink) == 1
db.close()
assert refusals((folder / "c.db").unlink) == 0
assert refusals(lambda: shutil.rmtree(folder / "sub")) == 0 and not (folder / "sub").exists()
source = "import os\\ndef f():\\n    import fcntl\\ndef g():\\n    return os.sysconf"
for name in ("jaxsfm.probe", "other"):
    space = {"__name__": name}
    exec(source, space)
    for act in (space["f"], space["g"]):
        try:
            act()
            assert name == "other"
        except (ModuleNotFoundError, AttributeError):
            assert name == "jaxsfm.probe"
print("in force")
"""
    assert as_on_windows(code, tmp_path) == "in force\n"


SMALL_PARTS = """
import contextlib, importlib, io, json, pkgutil, sys
from pathlib import Path
import numpy as np
folder, address = Path(sys.argv[1]), sys.argv[2]

missing = set()
for package in posix_only.OURS:
    top = importlib.import_module(package)
    for found in pkgutil.walk_packages(top.__path__, package + "."):
        if found.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            missing.add(error.name)

from jaxsfm.cli.main import main
from jaxsfm.errors import UserError
from jaxsfm.io.download import download
from jaxsfm.io.libraries import total_memory
from jaxsfm.io.libraries import usable_cores
from jaxsfm.io.work_folder import lock_folder, open_folder

assert total_memory() > 1e8 and usable_cores() >= 1
with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
    main(["--help"])
assert "reconstruct" in text.getvalue()

out = folder / "out"
identity = {"seed": 0, "images": {"a.jpg": "00"}}
for seed in (0, 1):
    with open_folder(out, {**identity, "seed": seed}) as work:
        try:
            with lock_folder(out):
                raise AssertionError("locked twice")
        except UserError as error:
            assert "another run is using this folder" in str(error)
        for content in ("one", "two"):
            key = f"{content} {seed}"
            made = work.stage("mapping", key, lambda f: (f / "x").write_bytes(content.encode()))
            assert (made / "x").read_bytes() == content.encode()
            with work.publish() as fresh:
                (fresh / "sparse").mkdir()
                (fresh / "sparse" / "x").write_bytes(key.encode())
                (fresh / "report.json").write_bytes(b"{}")
            assert (out / "sparse" / "x").read_bytes() == key.encode()

for _ in range(2):
    download(address, folder / "file", known_hash=None)

from jaxsfm.bench.synthetic import write_photo
rng = np.random.default_rng(0)
for name in ("a.png", "b.png"):
    write_photo(folder / name, rng.integers(0, 255, (96, 128, 3), np.uint8))
args = ["match", str(folder / "a.png"), str(folder / "b.png"), "--out", str(folder / "m.npz")]
assert main([*args, "--preset", "paper"]) in (0, 1)
print(json.dumps({"missing": sorted(missing), "refused": posix_only.refused}))
"""


@pytest.mark.slow
@ON_LINUX
def test_every_module_is_imported_and_small_parts_work_without_what_windows_lacks(tmp_path, server):
    told = json.loads(as_on_windows(SMALL_PARTS, tmp_path, url(server)).splitlines()[-1])
    assert told["refused"] == []
    # Packages of extras that are not installed.
    assert {*told["missing"]} <= {"torch", "ray", "viser", "lightglue", "skimage"}
    assert (tmp_path / "file").read_bytes() == CONTENT
    assert forbidden_names(tmp_path) == []


WHOLE_RUN = """
import sys
from pathlib import Path
from jaxsfm.cli.main import main
scene, folder = Path(sys.argv[2]), Path(sys.argv[1])
photos, out = scene / "images", folder / "out"
known = ["--intrinsics", str(scene / "K.txt"), "--threads", "1"]
assert main(["reconstruct", str(photos), "--out", str(out), "--seed", "1", *known]) == 0
assert main(["extend", str(out)]) in (0, 1)
one = str(sorted(photos.iterdir())[0])
assert main(["localize", one, "--model", str(out), "--out", str(folder / "poses.json")]) == 0
for to in ("hloc", "colmap", "colmap-text", "nerfstudio", "undistorted"):
    (folder / to).mkdir()
    assert main(["export", str(out), "--to", to, "--out", str(folder / to)]) in (0, 2), to
for _ in range(2):
    target = str(folder / "model.ply")
    assert main(["export", str(out), "--to", "ply", "--out", target]) == 0
print(posix_only.refused)
"""


@ON_LINUX
@pytest.mark.slow
def test_a_whole_run_moves_and_deletes_no_file_that_is_open(tmp_path, scene, plain):
    shutil.copytree(plain[0], tmp_path / "out")  # its results are replaced
    assert as_on_windows(WHOLE_RUN, tmp_path, str(scene)).splitlines()[-1] == "[]"
    assert (tmp_path / "out" / "report.html").is_file() and forbidden_names(tmp_path) == []
    assert (tmp_path / "undistorted" / "sparse" / "0" / "cameras.bin").is_file()
