"""Fuzz cases in a process of their own, so that native code may crash or loop there.

As a script it takes MODULE FUNCTION FIRST-CASE NUMBER SCRATCH. The function gets a case's random
generator and the scratch folder, and returns what became of the case in a word. To repeat case 7
alone:
`JAXSFM_FUZZ_SEED=0 python tests/fuzz/fuzz_children.py test_fuzz_images image 7 1 /some/folder`.
"""

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from mutations import SEED, rng_of  # noqa: E402

ROOM = 2 << 30
"""Bytes of address space that a child may take beyond its imports, so that the size that a damaged
header claims cannot be allocated."""
CASE_S = 10
"""Seconds of computing that a case may take."""


def run_cases(
    module: str, function: str, count: int, scratch: Path, *, patience_s: float = 100
) -> Counter:
    """Run cases; returns how many of them ended how.

    A case that raises, ends its process or takes too long fails the test, and the failure names it.
    """
    command = [sys.executable, __file__, module, function, "0", str(count), str(scratch)]
    known = {"JAX_PLATFORMS": "cpu", "JAXSFM_FUZZ_SEED": str(SEED)}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=patience_s, env=os.environ | known
        )
        ended = f"exit {done.returncode}\n{done.stderr[-3000:]}" * bool(done.returncode)
    except subprocess.TimeoutExpired:
        ended = f"not done after {patience_s} s"
    if ended:
        at = (scratch / "case").read_text() if (scratch / "case").exists() else "none"
        raise AssertionError(f"JAXSFM_FUZZ_SEED={SEED}, {function}, case {at}: {ended}")
    return Counter(json.loads((scratch / "found.json").read_text()))


def main(module: str, function: str, first: str, count: str, scratch: str) -> None:
    folder = Path(scratch)
    folder.mkdir(parents=True, exist_ok=True)
    check = getattr(importlib.import_module(module), function)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, resource.RLIM_INFINITY))
    found: Counter = Counter()
    for case in range(int(first), int(first) + int(count)):
        (folder / "case").write_text(str(case))
        signal.setitimer(signal.ITIMER_PROF, CASE_S)  # its signal ends the process
        found[check(rng_of(function, case), folder)] += 1
    (folder / "found.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
