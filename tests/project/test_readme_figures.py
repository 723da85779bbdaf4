"""Each figure with which README sells the software stands in the page that it links to."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
NUMBER = re.compile(r"(?<![\w.-])\d+(?:\.\d+)?(?![\w.]*\w)")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def section(page: Path, anchor: str) -> str:
    """The text below a heading, up to the next heading that is not below it."""
    found: list[str] = []
    level = 0
    for line in page.read_text().splitlines():
        heading = re.match(r"(#+) (.*)", line)
        if heading and level and len(heading[1]) <= level:
            break
        if heading and not level:
            slug = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading[2]).strip().lower())
            level = len(heading[1]) if slug == anchor else 0
        if level:
            found.append(line)
    assert found, f"{page.name} has no section {anchor}"
    return "\n".join(found)


def numbers(text: str) -> set[str]:
    """Figures of a text. A range such as 0.041-0.047 is two figures; names and dates are none."""
    text = re.sub(r"\d{4}-\d\d-\d\d", " ", text)
    text = re.sub(r"(?<=\d)-(?=\d)", " ", text)
    return set(NUMBER.findall(text))


def claims(heading: str) -> list[str]:
    """The rows of a section's table, or its list items, each on one line."""
    text = section(README, heading)
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    return rows or [" ".join(item.split()) for item in text.split("\n* ")[1:]]


def missing(claim: str) -> set[str]:
    """The figures of a claim that none of the sections that it links to has."""
    pages = [link.partition("#") for link in LINK.findall(claim)]
    sources = " ".join(section(ROOT / page, anchor) for page, _, anchor in pages)
    said = claim if not claim.startswith("|") else " ".join(claim.split("|")[2:4])
    return numbers(LINK.sub(" ", said)) - numbers(sources)


@pytest.mark.parametrize("claim", claims("results"), ids=lambda row: row.split("|")[1].strip())
def test_each_figure_of_the_results_table_is_in_the_results(claim):
    assert all(link.startswith("docs/results.md#") for link in LINK.findall(claim))
    assert numbers(" ".join(claim.split("|")[2:4])), "a row without a figure"
    assert not missing(claim)


@pytest.mark.parametrize("claim", claims("how-fast"), ids=lambda item: item[:40])
def test_each_figure_of_speed_is_in_the_performance(claim):
    assert any(link.startswith("docs/performance.md#") for link in LINK.findall(claim))
    assert not missing(claim)


def test_a_figure_without_a_source_is_missed():
    row = "| castle | 0.0813 m | 0.0777-0.0263 m | [when](docs/results.md#the-ledger) |"
    assert missing(row) == {"0.0813", "0.0777"}


def test_readme_has_at_most_a_hundred_lines():
    assert len(README.read_text().splitlines()) <= 100
