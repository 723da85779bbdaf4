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
        if given.startswith("--"):
            name, equals, value = given.partition("=")
            option = name.replace("_", "-")
            if option in OPTIONS:
                _tell(option, OPTIONS[option])
                given = OPTIONS[option] + equals + value
        elif option == "--without" and given in STEPS:
            _tell(given, STEPS[given])
            given = STEPS[given]
        found.append(given)
    return found


def _tell(old: str, new: str) -> None:
    print(
        f"jaxsfm: {old} is called {new} now; the next version will not know {old}", file=sys.stderr
    )
