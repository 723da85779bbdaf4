"""A lock belongs to one process at a time, and vanishes with it."""

import contextlib
import errno
import subprocess
import sys

import filelock
import pytest
from local_server import CONTENT, url

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import only_process
from jaxsfm.io.download import download
from jaxsfm.io.work_folder import lock_folder

HOLD = """
import sys, time
from pathlib import Path
from jaxsfm.io.atomic import only_process
with only_process(Path(sys.argv[1]), "in use"):
    print("held", flush=True)
    time.sleep(600)
"""


@contextlib.contextmanager
def holder(lock):
    """Another process that holds a lock."""
    with subprocess.Popen([sys.executable, "-c", HOLD, str(lock)], stdout=subprocess.PIPE) as one:
        assert one.stdout is not None and one.stdout.readline().strip() == b"held"
        try:
            yield one
        finally:
            one.kill()


def test_a_lock_is_refused_until_the_process_that_holds_it_is_killed(tmp_path):
    with holder(tmp_path / ".lock") as other:
        for _ in range(2):  # a refusal does not take the lock away
            with pytest.raises(UserError, match="^another one$"):
                with only_process(tmp_path / ".lock", "another one"):
                    pytest.fail("locked twice")
        with pytest.raises(UserError, match="another run is using this folder"):
            with lock_folder(tmp_path):
                pytest.fail("locked twice")
        other.kill()
        other.wait()
        with only_process(tmp_path / ".lock", "another one"), pytest.raises(UserError):
            with only_process(tmp_path / ".lock", "still held"):
                pytest.fail("locked twice")


def test_a_file_that_a_killed_process_left_is_no_lock(tmp_path):
    """Also one with a process number in it, as locks have that are files alone."""
    for content in ("", "1\nhost\n"):
        (tmp_path / ".lock").write_text(content)
        with lock_folder(tmp_path):
            pass


def test_a_lock_is_given_back_after_an_error(tmp_path):
    for _ in range(2):
        with pytest.raises(KeyError), only_process(tmp_path / "lock", "in use"):
            raise KeyError


def test_a_file_system_without_locks_is_said_and_not_taken_for_another_run(tmp_path, monkeypatch):
    for number in (errno.ENOSYS, errno.ENOLCK):

        def no_locks(*_, number=number):
            raise OSError(number, "no locks here")

        module = sys.modules[filelock.FileLock.__module__]
        names = ("lock_fd_nonblocking", "_lock_fd_nonblocking")  # of filelock 4 and of 3.30
        (name,) = (each for each in names if hasattr(module, each))
        monkeypatch.setattr(module, name, no_locks)
        with pytest.raises(UserError, match="cannot be written .no locks here"):
            with lock_folder(tmp_path / "out"):
                pytest.fail("locked")


def test_a_download_that_another_process_makes_is_left_to_it(server, tmp_path):
    path = tmp_path / "file"
    with holder(tmp_path / "file.part.lock") as other:
        with pytest.raises(UserError, match="file.part: another process is downloading it"):
            download(url(server), path, known_hash=None)
        assert not path.exists()
        other.kill()
        other.wait()
    download(url(server), path, known_hash=None)
    assert path.read_bytes() == CONTENT and [p.name for p in tmp_path.iterdir()] == ["file"]
