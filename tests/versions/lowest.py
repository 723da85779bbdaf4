"""Constraints for pip: of every package the lowest version that pyproject.toml declares.

    python tests/versions/lowest.py        # writes tests/versions/lowest.txt

`make test-lowest` installs with them. A package whose lowest version is never tested would have a
bound that nobody knows to be true.
"""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILE = Path(__file__).parent / "lowest.txt"
TOOLS = ("dev", "docs", "notebooks")
"""Extras of those who work on jaxsfm, who have the versions of today."""
BESIDE = {"jaxlib": "jax"}
"""Packages that pyproject.toml does not name, because they come with another one of the same
version."""


def lower_bounds() -> dict[str, str]:
    """The lower bound of each package, by its name; ValueError for one without or with two."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"].items()
    users = [line for name, each in extras if name not in TOOLS for line in each]
    bounds: dict[str, str] = {}
    for line in [*project["dependencies"], *users]:
        name, extra, rest = re.fullmatch(r"([\w.-]+)(\[[^]]*\])?(.*)", line).groups()
        if name == "jaxsfm" or (extra and not rest):  # an extra of our own, or of JAX
            continue
        found = re.match(r"(?:>=|==)([\d.]+)", rest)
        if found is None:
            raise ValueError(f"a dependency must have a lower bound; got {line!r}")
        if bounds.setdefault(name, found[1]) != found[1]:
            raise ValueError(f"{name} must have one lower bound; got {bounds[name]} and {found[1]}")
    return bounds | {name: bounds[of] for name, of in BESIDE.items()}


def constraints() -> str:
    """The content of `FILE`."""
    return "".join(f"{name}=={bound}\n" for name, bound in sorted(lower_bounds().items()))


if __name__ == "__main__":
    FILE.write_text(constraints(), encoding="utf-8")
