"""An interrupt is noted, so that it cannot get lost; loops look for it between items.

An interrupt is Ctrl-C (SIGINT) or SIGTERM, which `kill`, `timeout` and cluster schedulers send.
Both raise KeyboardInterrupt in whatever Python code is running. If that is a callback of native
code, the exception may be swallowed: JAX's hook in the garbage collector did so in a test, and the
run went on to its end.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)

SWALLOWS = "_xla_gc_callback"
"""JAX's hook in the garbage collector. Python prints an exception in it with a traceback, and goes
on. So nothing is raised there, and `check` finds the interrupt."""

_pending, _noting = threading.Event(), threading.Event()


def _handle(number: int, frame: FrameType | None) -> None:
    _pending.set()
    while frame is not None and frame.f_code.co_name != SWALLOWS:
        frame = frame.f_back
    if frame is None:
        raise KeyboardInterrupt


def _in_main_thread() -> bool:
    """Only there does Python allow signal handlers."""
    return threading.current_thread() is threading.main_thread()


@contextlib.contextmanager
def noted() -> Iterator[None]:
    """Note every interrupt while the block runs, so that `check` finds it.

    This does nothing outside the main thread.
    """
    if not _in_main_thread():
        yield
        return
    _pending.clear()
    previous = {number: signal.signal(number, _handle) for number in SIGNALS}
    _noting.set()
    try:
        yield
    finally:
        _noting.clear()
        for number, handler in previous.items():
            signal.signal(number, handler)


def note_again() -> None:
    """Take the signals back from a library that was imported while interrupts are noted.

    pycolmap handles SIGTERM by a stack trace and the end of the process. Outside of `noted` this
    does nothing.
    """
    if _noting.is_set() and _in_main_thread():
        for number in SIGNALS:
            signal.signal(number, _handle)


def check() -> None:
    """Raise KeyboardInterrupt if an interrupt was noted and the exception has not arrived."""
    if _pending.is_set():
        _pending.clear()
        raise KeyboardInterrupt
