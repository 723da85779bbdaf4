"""What may go wrong around a run, made to happen in this very process, at a place that is named.

A place is an event that Python reports of itself (`sys.addaudithook`) and a part of the path that
it is about: `["open", "/matches/"]` is the first file of matches that is opened for writing.
"""

import ctypes
import functools
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

_BEGUN = [0.0]
_EVENTS = ("open", "os.mkdir", "os.rename")


def begin(wanted: dict) -> None:
    """Make faults happen; each is named by a key.

    full: [event, path, bytes]: from then on no file can be longer, in native code neither.
    signal: [event, path, number]: a signal is sent.
    remove: [event, path, file]: a file is deleted.
    memory: bytes that the process may take more than now.
    unread: [1], [2]: numbers of outputs that nobody reads.
    plain: root may write no more than other users may.
    usage: the seconds and the memory that were needed until the signal are printed.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _BEGUN[:] = [time.monotonic()]
    send = functools.partial(_send, usage=wanted.get("usage", False))
    for name, act in (("full", _fill), ("signal", send), ("remove", _delete)):
        if name in wanted:
            event, path, what = wanted[name]
            _at(event, path, lambda act=act, what=what: act(what))
    if "memory" in wanted:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + wanted["memory"]
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    for number in wanted.get("unread", ()):
        there, here = os.pipe()
        os.close(there)
        os.dup2(here, number)
    if wanted.get("plain"):
        _drop_capabilities()


def _at(event: str, part: str, act: Callable[[], object]) -> None:
    """Do something at a place, once."""
    assert event in _EVENTS, event
    done = threading.Event()

    def hook(name: str, args: tuple) -> None:
        if name != event or done.is_set() or not isinstance(args[0], str | bytes | os.PathLike):
            return
        if name == "open" and not args[2] & (os.O_WRONLY | os.O_RDWR):
            return
        if part in os.fsdecode(args[0]):
            done.set()
            act()

    sys.addaudithook(hook)


def _fill(most: int) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))


def _send(number: int, usage: bool) -> None:
    if usage:
        used = resource.getrusage(resource.RUSAGE_SELF)
        seconds = time.monotonic() - _BEGUN[0]
        print(f"usage: {seconds:.1f} s, {used.ru_maxrss * 1024} bytes", flush=True)
    os.kill(os.getpid(), number)


def _delete(path: str) -> None:
    os.unlink(path)


def _drop_capabilities() -> None:
    """Without its capabilities, root has the rights of a folder's owner, who can lack them."""
    if os.geteuid() == 0:
        header = (ctypes.c_uint32 * 2)(0x20080522, 0)
        if ctypes.CDLL(None, use_errno=True).capset(header, (ctypes.c_uint32 * 6)()):
            raise OSError(ctypes.get_errno(), "capset")
