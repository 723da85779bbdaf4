"""Long native calls, in a thread of their own, so that Ctrl-C is noticed."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pycolmap

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt

T = TypeVar("T")
THREAD = "jaxsfm-colmap"


def native(
    work: Callable[[pycolmap.CancellationToken], T], what: Path | str, *, grace_s: float = 30
) -> T:
    """Run native code in a thread of its own, and return its result.

    Args:
      work: the code. It gets a token that tells it to stop.
      what: the file or the task, for messages.
      grace_s: seconds that an interrupted call may take to stop.

    Raises:
      UserError: COLMAP failed.
      KeyboardInterrupt: Ctrl-C was pressed. The native code was asked to stop.
    """
    token = pycolmap.CancellationToken()
    results: list[T] = []
    failure: list[BaseException] = []
    done = threading.Event()

    def run() -> None:
        try:
            results.append(work(token))
        except BaseException as error:
            failure.append(error)
        finally:
            done.set()

    threading.Thread(target=run, name=THREAD, daemon=True).start()
    try:
        # Not Thread.join: after Ctrl-C inside it, Python 3.11 takes the thread for ended. The
        # process then ends while the native code still runs, and aborts.
        while not done.wait(0.2):
            interrupt.check()
        interrupt.check()
    except KeyboardInterrupt:
        token.cancel()
        done.wait(grace_s)
        raise
    if failure and isinstance(failure[0], RuntimeError):
        raise UserError(f"{what}: COLMAP failed ({failure[0]}); the matches are kept")
    if failure:
        raise failure[0]
    return results[0]
