"""Each page of the API has an example, which prints what the page says."""

import contextlib
import io
import re
from pathlib import Path

import pytest

API = Path(__file__).parents[2] / "docs" / "api"
PAGES = sorted(path for path in API.glob("*.md") if path.name != "index.md")
EXAMPLE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_example_of_a_page_prints_what_the_page_says(page):
    (example,) = EXAMPLE.findall(page.read_text(encoding="utf-8"))
    said = re.findall(r"^print\(.*\)  # (.*)$", example, flags=re.MULTILINE)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(example, page.name, "exec"), {"__name__": "example"})
    assert said and printed.getvalue().splitlines() == said
