"""A process that has imported everything, so that its children start at once.

It reads one request a line (JSON): the arguments of a command, and the faults that its child has to
live with (`faults`). It prints the child's process number, and its exit status (minus the signal)
when it has ended. Run it as a script with the folder of compiled programs.
"""

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

_BAR = re.compile(r"\r?[a-z ]+: +(\d+%\|[^\]]*|\d+pass \[[^\]]*)\]|\r|\x1b\[A")
"""A progress bar, from the beginning of its line."""


class Nursery:
    """The other end: it starts the process and sends commands to it.

    Args:
      folder: of compiled programs, and of the log of all commands.
    """

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, __file__, str(folder)]
        self._process = subprocess.Popen(command, stdin=-1, stdout=-1, text=True, bufsize=1)
        self.log = folder / "log"

    def run(
        self, argv: list[str], kill_after: float | None = None, faults: dict | None = None
    ) -> tuple[int, float]:
        """Exit status (minus the signal) and seconds of a command."""
        assert self._process.stdin and self._process.stdout
        start = time.monotonic()
        self._process.stdin.write(json.dumps([argv, faults or {}]) + "\n")
        child = int(self._process.stdout.readline())
        if kill_after is not None:
            ended, _, _ = select.select([self._process.stdout], [], [], kill_after)
            if not ended:
                with contextlib.suppress(ProcessLookupError):  # at this very moment
                    os.kill(child, signal.SIGKILL)
        return int(self._process.stdout.readline()), time.monotonic() - start

    def said(self, argv: list[str], faults: dict) -> tuple[int, str]:
        """Exit status of a command, and what it said, without its progress bars."""
        before = self.log.stat().st_size if self.log.exists() else 0
        status, _ = self.run(argv, faults=faults)
        text = self.log.read_bytes()[before:].decode("utf-8", "replace")
        # A progress bar ends with what moves the cursor, and what is said may follow at once.
        lines = _BAR.sub("\n", text).splitlines()
        return status, "\n".join(line for line in lines if line.strip())

    def end(self) -> None:
        self._process.communicate(timeout=60)


def _child(argv: list[str], wanted: dict, log: int) -> int:
    import faults

    import jaxsfm.cli.main

    os.setsid()  # what it starts and leaves can be found
    os.dup2(log, 1)
    os.dup2(log, 2)
    faults.begin(wanted)
    return jaxsfm.cli.main.main(argv)


def main(compiled: str) -> None:
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "true"
    os.environ["JAX_COMPILATION_CACHE_DIR"] = compiled
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    # Everything a run imports late; no JAX computation before the fork.
    import jaxsfm.cli.main  # noqa: I001
    import jaxsfm.report.page.write  # noqa: F401
    import jaxsfm.sfm.refine.passes  # noqa: F401
    import jaxsfm.runs.reconstruct  # noqa: F401

    for line in sys.stdin:
        # The child writes into a pipe: into a file, a full disk would silence it.
        there, here = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(there)
            os._exit(_child(*json.loads(line), here))
        os.close(here)
        print(child, flush=True)
        with (Path(compiled) / "log").open("ab", buffering=0) as log:
            while data := os.read(there, 1 << 16):
                log.write(data)
        os.close(there)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, 0)
            status = 999
        print(status, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
