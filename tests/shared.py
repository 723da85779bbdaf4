"""Folders that several tests read: each is made once in a session and stays as it was made."""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from filelock import FileLock


@contextlib.contextmanager
def once(
    factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]
) -> Iterator[Path]:
    """The folder `name`, which `make` fills once in a session.

    With pytest-xdist each worker is a process with its own session fixtures. The first worker that
    asks for a folder makes it, and the others wait for it; pytest-xdist's documentation advises
    this lock.

    No test may change the folder; a test that has to change something copies it. This is checked
    when the session ends. Permissions would not do: root may write anyway, and copies inherit them.
    """
    base = factory.getbasetemp()
    root = base.parent if base.name.startswith("popen-") else base  # of all workers
    folder, made = root / name, root / f"{name}.made"
    with FileLock(root / f"{name}.lock"):
        if not made.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            made.touch()
    before = _state(folder)
    yield folder
    after = _state(folder)
    changed = sorted(path for path in before | after if before.get(path) != after.get(path))
    assert not changed, f"a test changed {folder}, which all tests share: {changed}"


def _state(folder: Path) -> dict[str, tuple[int, int]]:
    """The size and the time of the last change of each file but locks, which readers touch."""
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file() and path.name != ".lock"
    }
