"""Ctrl-C that cannot get lost.

Python raises KeyboardInterrupt wherever it happens to be, and callbacks of native code swallow it:
JAX's hook in the garbage collector did, in a test that ended with a finished run (measured). So the
handler also leaves a note, and loops look for it between items.
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
    """Note Ctrl-C while the block runs; outside the main thread signals are not ours."""
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
    """Raise the KeyboardInterrupt that was noted and has not arrived."""
    if _pending.is_set():
        _pending.clear()
        raise KeyboardInterrupt
