"""The documentation builds without warnings, and its figures are what the notebooks show."""

import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def site(tmp_path):
    """A copy to build in, so that nothing of an earlier build is taken over."""
    pytest.importorskip("zensical")
    for name in ("docs", "jaxsfm"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "zensical.toml", tmp_path)
    return tmp_path


def build(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_has_every_page(site):
    done = build(site)
    text = done.stdout + done.stderr
    assert done.returncode == 0 and "arning" not in text, text
    for page in (site / "docs").rglob("*.md"):
        built = site / "build/site" / page.relative_to(site / "docs").with_suffix(".html")
        assert built.is_file(), page
    reference = (site / "build/site/api/features.html").read_text()
    assert 'id="jaxsfm.core.relocalize.relocalize"' in reference
    assert not re.search(r'(src|href)="https?://[^"]*\.(css|js|woff2?)"', reference)


@pytest.mark.slow
def test_a_link_to_nowhere_stops_the_build(site):
    index = site / "docs/index.md"
    index.write_text(index.read_text() + "\n[gone](gone.md)\n")
    assert build(site).returncode != 0


def test_every_page_is_in_the_navigation():
    listed = re.findall(r'"([\w/-]+\.md)"', (ROOT / "zensical.toml").read_text())
    pages = [str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted(pages)


def test_figures_are_those_of_the_notebooks():
    found = runpy.run_path(str(ROOT / "notebooks/figures.py"))["figures"]()
    shown = (ROOT / "docs/how-it-works.md").read_text()
    for name, image in found.items():
        assert (ROOT / "docs/images" / name).read_bytes() == image, "python notebooks/figures.py"
        assert f"(images/{name})" in shown
