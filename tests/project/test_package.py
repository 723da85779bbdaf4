"""What is released: wheel and sdist hold the package whole, and it works away from the sources."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = (
    "jaxsfm/py.typed",
    "jaxsfm/relocalizer.safetensors",
    *(f"jaxsfm/report/page/page.{kind}" for kind in ("html", "css", "js")),
)


def test_every_package_is_named_for_the_build():
    """The build takes the packages of a list; one that the list lacks would not be installed."""
    named = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "jaxsfm").rglob("__init__.py")}
    there = {".".join(folder.parts) for folder in folders} | {"jaxsfm.weights_conversion"}
    assert sorted(named) == sorted(there)


def test_the_weights_conversion_of_a_checkout_is_the_one_that_is_installed():
    from jaxsfm.weights_conversion import convert

    assert Path(convert.__file__).resolve() == ROOT / "weights_conversion" / "convert.py"


def test_every_action_of_the_workflows_is_pinned_by_a_commit():
    """A tag can be moved to other code. The comment says which version the commit is."""
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        used = re.findall(r"uses: *(.*)", path.read_text())
        assert used and all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40} # v[\d.]+", each) for each in used)


def test_the_citation_is_of_this_version_and_has_a_date():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {version}\n" in citation
    assert re.search(r"\ndate-released: \d{4}-\d\d-\d\d\n", citation)


def run(*command: object, cwd: Path, **environment: str) -> str:
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": "", **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """sdist, and the wheel made of it: what is not in the sdist is not in the wheel."""
    pytest.importorskip("build")
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in run("git", "ls-files", cwd=ROOT).splitlines():
        if (ROOT / name).is_file() and not name.startswith("docs/"):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, source, cwd=source)
    return out


@pytest.mark.slow
def test_wheel_and_sdist_hold_all_modules_and_data(built):
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    in_wheel = set(zipfile.ZipFile(wheel).namelist())
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    beside = {path.name for path in (ROOT / "weights_conversion").glob("*.py")}
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "jaxsfm").rglob("*.py")}
    installed = sources | {f"jaxsfm/weights_conversion/{name}" for name in beside}
    assert installed | set(DATA) <= in_wheel
    assert sources | {f"weights_conversion/{name}" for name in beside} | set(DATA) <= in_sdist
    top = {name.partition("/")[0] for name in in_wheel}
    assert {name for name in top if not name.endswith(".dist-info")} == {"jaxsfm"}
    assert not [name for name in in_wheel if re.search(r"(^|/)(tests|test_|conftest)", name)]
    assert wheel.stat().st_size < 1_000_000


@pytest.mark.slow
def test_a_wheel_works_in_an_environment_of_its_own(built, tmp_path):
    """Its dependencies are those of this environment, by a path; the package is the wheel's."""
    place = tmp_path / "env"
    venv.create(place, with_pip=False)
    python = place / "bin" / "python"
    site = next((place / "lib").glob("python*/site-packages"))
    (wheel,) = built.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(site)
    others = [sysconfig.get_path("purelib"), sysconfig.get_path("platlib")]
    (site / "others.pth").write_text("\n".join(dict.fromkeys(others)))
    where = run(python, "-c", "import jaxsfm; print(jaxsfm.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(site.resolve()) or str(site) in where
    assert run(python, "-m", "jaxsfm", "--version", cwd=tmp_path).startswith("jaxsfm ")
    assert "checked" in run(python, "-m", "jaxsfm", "weights", cwd=tmp_path)
