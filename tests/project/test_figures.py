"""Each table of the results and each picture has a command that makes it, on one page."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "decisions" / "figures.md").read_text(encoding="utf-8")
RESULTS = (DOCS / "results.md").read_text(encoding="utf-8")
SECTIONS = {
    heading: text
    for heading, text in re.findall(
        r"^##+ (.*?)\n(.*?)(?=^##|\Z)", RESULTS, flags=re.MULTILINE | re.DOTALL
    )
}
ROWS = {
    heading: (command, source)
    for heading, command, source in re.findall(
        r"^\| \[([^]]*)\]\([^)]*\) \| (.*?) \| (.*?) \|$", PAGE, flags=re.MULTILINE
    )
}


def test_every_section_of_the_results_has_a_row_and_no_other():
    assert list(ROWS) == list(SECTIONS)


@pytest.mark.parametrize("heading", ROWS)
def test_the_command_of_a_row_stands_in_its_section(heading):
    command, section = ROWS[heading][0], SECTIONS[heading]
    if command == "gone":
        assert "| command |" in section
    elif command == "in each row":
        rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
        assert rows and all("`jaxsfm " in row.split("|")[2] for row in rows)
    elif heading != "Cup":  # one of the ledger's sets
        assert f"    {command.strip('`')}\n" in section


@pytest.mark.parametrize("heading", [name for name in ROWS if ROWS[name][0] != "gone"])
def test_a_section_with_figures_says_when_they_were_made(heading):
    assert re.search(r"20\d\d-\d\d-\d\d", SECTIONS[heading])


def test_every_picture_has_a_row_and_no_other():
    named = re.findall(r"`(\w+\.(?:jpg|png))`", PAGE)
    there = [path.name for path in (DOCS / "images").iterdir()]
    assert sorted(named) == sorted(there)
