"""What an installation without extras can do, and what it says of the rest."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from jaxsfm.errors import UserError
from jaxsfm.io import extras
from jaxsfm.io.extras import EXTRAS, extra, missing, require

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DEVELOPERS = {"bench", "dev", "docs", "notebooks"}
BARE = f"""
import builtins, sys
real, hidden = builtins.__import__, {sorted(m for e in EXTRAS.values() for m in e.packages)!r}
def imported(name, globals=None, locals=None, fromlist=(), level=0):
    ours = (globals or {{}}).get("__name__", "").partition(".")[0] in ("jaxsfm", "__main__")
    if level == 0 and ours and name.partition(".")[0] in hidden:
        raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
    return real(name, globals, locals, fromlist, level)
builtins.__import__ = imported
"""
"""Our modules find no package of an extra. Others do: flax may import optax."""


def bare(code: str, *args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", BARE + code, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def name_of(requirement: str) -> str:
    return re.split(r"[\[<>=!~; ]", requirement, maxsplit=1)[0]


def test_the_extras_that_are_explained_are_those_that_can_be_installed():
    declared = PROJECT["optional-dependencies"]
    assert set(EXTRAS) == set(declared) - DEVELOPERS
    for name in set(EXTRAS) - {"cuda12", "cuda13", "tpu"}:  # JAX says what these bring
        # A newer Pillow, which reads AVIF, is no package of its own.
        brought = {name_of(each) for each in declared[name]} - {"pillow"}
        assert set(EXTRAS[name].packages.values()) == brought, name


def test_every_package_that_is_imported_is_declared():
    """A package that only another package brings can be gone with its next release."""
    code = """
import ast, json, pathlib, sys
found = set()
for path in pathlib.Path(sys.argv[1]).rglob("*.py"):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.partition(".")[0])
print(json.dumps(sorted(found - set(sys.stdlib_module_names))))
"""
    found = set()
    for folder in ("jaxsfm", "weights_conversion"):
        found |= set(json.loads(bare(code, ROOT / folder).stdout))
    modules = {"cv2": "opencv-python-headless", "PIL": "pillow", "markupsafe": "jinja2"}
    declared = {name_of(each) for each in PROJECT["dependencies"]} | {
        module for each in EXTRAS.values() for module in each.packages
    }
    # Only type checkers read the stubs of Python's own library.
    assert {modules.get(name, name) for name in found} - {"jaxsfm", "_typeshed"} <= declared


def test_without_extras_all_modules_load_but_those_of_the_extras():
    code = """
import importlib, json, pkgutil
import jaxsfm
from jaxsfm.errors import UserError
refused = {}
for module in pkgutil.walk_packages(jaxsfm.__path__, "jaxsfm."):
    if not module.name.endswith(("__main__", "hdf5_child")):
        try:
            importlib.import_module(module.name)
        except UserError as error:
            refused[module.name] = str(error)
print(json.dumps(refused))
"""
    done = bare(code)
    assert done.returncode == 0, done.stderr
    named = {module: text.rpartition(": ")[2] for module, text in json.loads(done.stdout).items()}
    assert named == {
        "jaxsfm.colmap.formats.dense_matches": "pip install 'jaxsfm[hdf5]'",
        "jaxsfm.colmap.formats.hloc": "pip install 'jaxsfm[hdf5]'",
        "jaxsfm.report.plot": "pip install 'jaxsfm[plots]'",
        "jaxsfm.training.relocalizer": "pip install 'jaxsfm[train]'",
    }


@pytest.mark.slow
def test_a_whole_run_needs_no_extra(scene, tmp_path):
    code = "from jaxsfm.cli.main import main; sys.exit(main(sys.argv[1:]))"
    out = tmp_path / "out"
    known = ("--intrinsics", scene / "K.txt")
    done = bare(code, "reconstruct", scene / "images", "--out", out, *known)
    assert done.returncode == 0, done.stderr
    assert (out / "report.html").is_file()


@pytest.mark.parametrize(
    ("args", "name"),
    [
        (["match", "a.jpg", "b.jpg", "--out", "m.npz", "--plot", "m.png"], "plots"),
        (["train", "relocalizer", "--images", ".", "--out", "r.safetensors"], "train"),
        (["bench", "daynight", "--root", ".", "--curves", "c.png"], "plots"),
    ],
)
def test_a_missing_extra_is_said_before_any_work(args, name, tmp_path, monkeypatch, capsys):
    """The photos do not exist, and nothing has looked for them yet."""
    from jaxsfm.cli.main import main

    monkeypatch.chdir(tmp_path)
    for module in EXTRAS[name].packages:
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "jaxsfm.training.relocalizer", raising=False)
    assert main(args) == 2
    assert capsys.readouterr().err.strip().endswith(f": pip install 'jaxsfm[{name}]'")


def test_only_packages_of_the_extra_are_excused(monkeypatch):
    with pytest.raises(ModuleNotFoundError, match="no_such_module"), extra("geo", "this needs"):
        import no_such_module  # noqa: F401
    with pytest.raises(UserError, match=r"this needs pyproj, which does not load \(no PROJ\)"):
        with extra("geo", "this needs"):
            raise ImportError("no PROJ", name="pyproj")
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert missing("geo") == ["pyproj"]
    with pytest.raises(UserError, match=r"this needs pyproj: pip install 'jaxsfm\[geo\]'"):
        require("geo", "this needs")
    monkeypatch.setattr(extras, "_found", lambda module: True)
    require("geo", "this needs")
