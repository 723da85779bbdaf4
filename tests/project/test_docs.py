"""The documentation builds without warnings and agrees with the code and the notebooks."""

import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from jaxsfm.cli import reference

ROOT = Path(__file__).parents[2]
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "notebooks/README.md",
    ROOT / "weights_conversion/README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
)


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


def headings(page: Path) -> set[str]:
    """The anchors of a page's headings, as Python-Markdown makes them."""
    found = re.findall(r"^#+ (.*)$", page.read_text(), flags=re.MULTILINE)
    kept = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in found]
    return {re.sub(r"[-\s]+", "-", heading) for heading in kept}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings_that_exist(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in headings(target), link


def test_the_command_line_reference_is_what_the_commands_print():
    page = (ROOT / "docs/reference/cli.md").read_text()
    assert page == reference.page(), "python -m jaxsfm.cli.reference docs/reference/cli.md"


def test_the_reference_describes_an_option_again_only_where_it_differs():
    shown: dict[str, tuple[str, str]] = {}
    first = (
        "usage: a\n\nDo it.\n\n options\n -----\n  -h, --help  help\n"
        "  --seed INT  The seed. (default: 0)\n  --out {None}|PATH\n    Here. (default: None)"
    )
    again = (
        "usage: b\n\nAlso.\n\n options\n --\n  --seed INT\n    The\n    seed. (default: 1)\n"
        "  --out {None}|PATH  Here. (default: None)\n  --new, --no-new  Here. (default: False)"
    )
    other = "usage: c\n\nNo.\n\n options\n --\n  --seed INT  Another seed. (default: 0)"
    assert reference.section(first, "a", shown) == (
        "Do it.\n\n* `--seed INT`: The seed. (default: 0)\n* `--out PATH`: Here."
    )
    assert reference.section(again, "b", shown) == (
        "Also.\n\n* `--new`: Here.\n* `--seed` (default: 1), `--out`: as in [jaxsfm a](#jaxsfm-a)"
    )
    assert "* `--seed INT`: Another seed." in reference.section(other, "c", shown)


def test_the_reference_has_every_option_of_every_command():
    page = reference.page()
    for heading, text in re.findall(r"^##+ jaxsfm ([^\n]*)\n(.*?)(?=^##|\Z)", page, re.M | re.S):
        words = tuple(heading.split())
        options = set(re.findall(r"^  (--[a-z][\w-]*)", reference.help_text(words), re.M))
        missing = {option for option in options if not re.search(rf"`{option}[ `]", text)}
        assert not missing, heading


def test_the_architecture_names_the_packages_and_only_modules_that_exist():
    text = (ROOT / "docs/architecture.md").read_text()
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    packages = [name.strip() for layer in layers for name in layer.split("|")]
    assert sorted(re.findall(r"^\| `(\w+)` \|", text, flags=re.MULTILINE)) == sorted(packages)
    for path in re.findall(r"`([\w/]+(?:\.py|\.html|/))`", text):
        assert (ROOT / "jaxsfm" / path).exists() or (ROOT / path).exists(), path


def test_pages_that_the_code_names_exist():
    sources = [
        path for name in ("jaxsfm", "weights_conversion") for path in (ROOT / name).rglob("*.py")
    ]
    for path in sources:
        for named in re.findall(r"docs/[\w/-]+\.md", path.read_text()):
            assert (ROOT / named).is_file(), f"{path.relative_to(ROOT)}: {named}"
