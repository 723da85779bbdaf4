"""The lowest versions that are tested are those that pyproject.toml declares."""

import re
import runpy
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOWEST = runpy.run_path(str(ROOT / "tests" / "versions" / "lowest.py"))
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_constraints_follow_from_the_declared_lower_bounds():
    written = LOWEST["FILE"].read_text(encoding="utf-8")
    assert written == LOWEST["constraints"](), "python tests/versions/lowest.py"
    assert "numpy==2\n" in written and "jax==0.10\n" in written and "jaxlib==0.10\n" in written


def test_every_dependency_of_a_plain_run_has_a_lower_bound():
    names = [re.match(r"[\w.-]+", line)[0] for line in SETTINGS["project"]["dependencies"]]
    assert names and set(names) <= set(LOWEST["lower_bounds"]())


@pytest.mark.parametrize("line", ["numpy", "numpy<3", "pillow>=99"])
def test_a_package_without_a_bound_or_with_two_is_refused(line, monkeypatch, tmp_path):
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    changed = text.replace("dependencies = [\n", f'dependencies = [\n  "{line}",\n', 1)
    assert changed != text
    (tmp_path / "pyproject.toml").write_text(changed, encoding="utf-8")
    bounds = LOWEST["lower_bounds"]
    monkeypatch.setitem(bounds.__globals__, "ROOT", tmp_path)
    with pytest.raises(ValueError, match="one lower bound|must have a lower bound"):
        bounds()


def test_the_pythons_that_make_tests_are_the_declared_ones():
    declared = [
        each.rpartition(" :: ")[2]
        for each in SETTINGS["project"]["classifiers"]
        if each.startswith("Programming Language :: Python :: 3.")
    ]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    tested = re.search(r"^PYTHONS \?= (.*)$", makefile, flags=re.MULTILINE)[1].split()
    # 3.14 is declared, and not tested before all packages have wheels for it.
    assert [f"python{each}" for each in declared if each != "3.14"] == tested


def test_deprecations_are_errors_in_tests_and_each_exception_says_whose_it_is():
    filters = SETTINGS["tool"]["pytest"]["ini_options"]["filterwarnings"]
    assert filters[0] == "error"
    lines = (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    for each in filters[1:]:
        (at,) = [k for k, line in enumerate(lines) if line.strip().startswith(f'"{each}"')]
        assert lines[at - 1].strip().startswith("#"), f"{each}: give the reason in a comment"
