"""An interrupt (Ctrl-C) is noted, so that it cannot get lost; loops look for it between items.

Python raises KeyboardInterrupt in whatever code is running. If that is a callback of native code,
the exception may be swallowed: JAX's hook in the garbage collector did so in a test, and the run
went on to its end.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_pending = threading.Event()


def _handle(number: int, frame: FrameType | None) -> None:
    _pending.set()
    raise KeyboardInterrupt


@contextlib.contextmanager
def noted() -> Iterator[None]:
    """Note every Ctrl-C while the block runs, so that `check` finds it.

    This does nothing outside the main thread, where Python allows no signal handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _pending.clear()
    previous = signal.signal(signal.SIGINT, _handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def check() -> None:
    """Raise KeyboardInterrupt if Ctrl-C was noted and the exception has not arrived."""
    if _pending.is_set():
        _pending.clear()
        raise KeyboardInterrupt
