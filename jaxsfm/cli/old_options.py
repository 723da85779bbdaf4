"""Options under the names that they had in the version before, which are read for one version."""

import sys
from collections.abc import Sequence

OPTIONS = {"--first-look": "--low-resolution"}
STEPS = {"map-again": "remap", "second-places": "pose-ambiguity"}
"""Values of `--without`."""


def current(argv: Sequence[str]) -> list[str]:
    """Arguments with the names of this version. Each old name is told on the standard error."""
    found, option = list[str](), ""
    for given in argv:
        name, equals, value = given.partition("=")
        if given.startswith("--"):
            name = "--" + name[2:].replace("_", "-")
            option = name
        if given.startswith("--") and name in OPTIONS:
            _tell(name, OPTIONS[name])
            found.append(OPTIONS[name] + equals + value)
        elif option == "--without" and given in STEPS:
            _tell(given, STEPS[given])
            found.append(STEPS[given])
        else:
            found.append(given)
    return found


def _tell(old: str, new: str) -> None:
    print(
        f"jaxsfm: {old} is called {new} now; the next version will not know {old}", file=sys.stderr
    )
