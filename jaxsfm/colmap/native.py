"""Long native calls beside the calling thread, which stays open to Ctrl-C."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2  # noqa: F401  before pycolmap: see jaxsfm.colmap.database
import pycolmap

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt

T = TypeVar("T")
THREAD = "jaxsfm-colmap"
"""Name of the thread COLMAP runs in."""


def native(
    work: Callable[[pycolmap.CancellationToken], T], what: Path | str, *, grace_s: float = 30
) -> T:
    """The result of `work`, run in a thread of its own.

    Args:
      work: gets a token that tells it to stop.
      what: named in messages.
      grace_s: how long an interrupted call may take to stop.

    Raises:
      UserError: COLMAP failed.
      KeyboardInterrupt: Ctrl-C; the native code was asked to stop.
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
        # Not Thread.join: Ctrl-C inside it makes Python 3.11 take the thread for ended, and the
        # process then aborts under the native code that still runs.
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
