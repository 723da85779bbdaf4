"""What a report of a fault needs to know of an installation (`jaxsfm doctor`).

This process loads neither JAX nor COLMAP. The process of `jaxsfm.runs.self_test` does, so that
everything else is known even if that process dies. Paths are left out unless they are asked for,
because they can name a person.
"""

import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jaxsfm
from jaxsfm.io.extras import EXTRAS, missing
from jaxsfm.io.libraries import total_memory, usable_cores
from jaxsfm.runs.self_test import STEPS

PATIENCE_S = 1200.0
"""How long the self test may take, seconds. It takes 4 s of a core's time, and 17 s if it has to
compile its programs. In a fresh environment on a machine with five other programs it took 470 s."""
MOST_LINES = 5
"""So many of the last lines that libraries wrote to the terminal are shown if a step failed."""
_PATH = re.compile(r"""(?<![\w:/\\.])(?:[A-Za-z]:)?[\\/][^\s'";,()]+""")
_SECRET = re.compile(r"(?<=://)[^/@\s]+@")


class Finding(NamedTuple):
    """A line of the doctor's report."""

    name: str
    text: str
    good: bool = True
    """Whether a plain run can do with it."""


def findings(*, paths: bool) -> Iterator[Finding]:
    """Yield what is found, one after the other; the self test comes last, as it takes longest.

    Nothing raises: a question that fails is a finding that is not good.

    Args:
      paths: whether the texts may have paths.
    """
    asked: list[tuple[str, Callable[[], list[Finding]]]] = [
        ("versions", _versions),
        ("system", _system),
        ("places", lambda: _places() if paths else []),
        ("cache", _cache),
        ("self test", _self_test),
        ("extras", _extras),
    ]
    for name, ask in asked:
        try:
            found = ask()
        except Exception as error:  # noqa: BLE001
            found = [Finding(name, f"{type(error).__name__}: {error}", good=False)]
        yield from found if paths else (each._replace(text=hidden(each.text)) for each in found)


def hidden(text: str) -> str:
    """The text with PATH in place of each path, and without passwords in addresses."""
    own = {str(Path.home()), os.getcwd(), sys.prefix, os.environ.get("JAX_COMPILATION_CACHE_DIR")}
    for place in sorted(filter(None, own), key=len, reverse=True):  # they may have spaces
        if len(place) > 1:
            text = re.sub(re.escape(place) + r"""[^\s'";,()]*""", "PATH", text)
    return _SECRET.sub("", _PATH.sub("PATH", text))


def _versions() -> list[Finding]:
    found = [Finding("python", f"{platform.python_version()} ({platform.python_implementation()})")]
    try:
        needed = importlib.metadata.requires("jaxsfm") or []
    except importlib.metadata.PackageNotFoundError:
        return [*found, Finding("jaxsfm", "not installed; it runs from its source code")]
    found.append(Finding("jaxsfm", importlib.metadata.version("jaxsfm")))
    plain = [each for each in needed if "extra ==" not in each]
    for name in ("jaxlib", *(re.split(r"[^\w.-]", each, maxsplit=1)[0] for each in plain)):
        try:
            found.append(Finding(name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            # Another build of OpenCV does as well, so this alone is no fault.
            found.append(Finding(name, "not installed", good=name.startswith("opencv")))
    return found


def _system() -> list[Finding]:
    return [
        Finding("system", f"{platform.system()} {platform.release()}, {platform.machine()}"),
        Finding("cores", f"{usable_cores()} of {os.cpu_count()}"),
        Finding("memory", f"{total_memory() / 1e9:.1f} GB"),
    ]


def _places() -> list[Finding]:
    return [
        Finding("interpreter", sys.executable),
        Finding("package", str(Path(jaxsfm.__file__).parent)),
    ]


def _cache() -> list[Finding]:
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if not folder:
        return [Finding("cache", "compiled programs cannot be kept: each run compiles them again")]
    files = [each for each in Path(folder).rglob("*") if each.is_file()]
    size = sum(each.stat().st_size for each in files) / 1e6
    return [
        Finding("cache", f"{len(files)} files of compiled programs, {size:.0f} MB, in {folder}")
    ]


def _extras() -> list[Finding]:
    found = []
    for name, each in EXTRAS.items():
        lacking = missing(name)
        state = f"missing: {', '.join(lacking)}; needed for" if lacking else "installed, for"
        found.append(Finding(f"extra {name}", f"{state} {each.use}"))
    return found


def _self_test() -> list[Finding]:
    """Run the self test in a process of its own; it sees the modules that this process sees."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "PYTHONIOENCODING": "utf-8",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # another run may use the GPU
    }
    try:
        child = subprocess.run(
            [sys.executable, "-m", "jaxsfm.runs.self_test"],
            env=environment,
            capture_output=True,
            timeout=PATIENCE_S,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired as error:
        said, end = error.stdout or b"", f"it had not ended after {PATIENCE_S:g} s"
        noise = error.stderr or b""
    else:
        said, end, noise = child.stdout, _ending(child.returncode), child.stderr
    found = _steps(said.decode("utf-8", "replace"), end)
    lines = noise.decode("utf-8", "replace").split("\n")
    last = [line.strip() for line in lines if line.strip()][-MOST_LINES:]
    if not all(each.good for each in found):
        found += [Finding("", line) for line in last]
    return found


def _steps(said: str, end: str) -> list[Finding]:
    """The findings of the self test's steps.

    Args:
      said: what its process printed; lines that are not its own are passed over.
      end: how the process ended, in words.
    """
    states: dict[str, tuple[str, str]] = {}
    for line in said.splitlines():
        try:
            step = json.loads(line)
            states[step["step"]] = (step["state"], step["text"])
        except (ValueError, TypeError, KeyError):
            continue
    found: list[Finding] = []
    for name in STEPS:
        state, text = states.get(name, ("absent", "left out, because a step before it failed"))
        if state == "begun":
            text = f"the process ended in this step: {end}"
        elif state == "absent" and all(each.good for each in found):
            text = f"the process ended before this step: {end}"
        found.append(Finding(f"test {name}", text, good=state == "done"))
    return found


def _ending(status: int) -> str:
    return f"signal {-status}" if status < 0 else f"exit status {status}"
