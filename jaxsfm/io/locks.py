"""Locks that keep two processes from writing the same files.

The operating system holds such a lock for its process, so it vanishes with the process, even if
that is killed.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from jaxsfm.errors import UserError


@contextlib.contextmanager
def only_process(lock: Path, in_use: str) -> Iterator[None]:
    """Hold a lock while the block runs.

    Args:
      lock: the file that is locked; it is made if it is missing. Its folder must exist.
      in_use: what to tell the user if another process holds the lock.

    Raises:
      UserError: another process holds the lock. This is not waited for.
      OSError: the file cannot be written, or its file system has no locks.
    """
    # On a file system without locks, filelock would write a file that a killed process leaves.
    held = FileLock(lock, fallback_to_soft=False)
    try:
        held.acquire(blocking=False)
    except Timeout as error:
        raise UserError(in_use) from error
    try:
        yield
    finally:
        held.release()
