"""Downloads of public weights and data sets.

An interrupted download is resumed, the file is compared with its hash, and archives are unpacked so
that they cannot write outside their folder.
"""

import contextlib
import hashlib
import lzma
import os
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import requests
from tqdm import tqdm

from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import only_process

CHUNK = 1 << 16
TIMEOUT = (10, 60)
"""The longest time to wait for the connection, and between two parts of a file, seconds."""
OnBytes = Callable[[int, int | None], None]
"""Is called with the bytes received so far and in total; None if the server does not say."""

_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    RuntimeError,  # the zip is encrypted, or something in it is not implemented
)


class _Download:
    """Continues what an earlier attempt left in FILE.part.

    The server's validator (ETag) is kept beside it. If the file on the server has changed since,
    the download starts again.
    """

    def __init__(self, path: Path, known_hash: str | None, on_bytes: OnBytes) -> None:
        self.path, self.known_hash, self.on_bytes = path, known_hash, on_bytes
        self.part = path.with_name(path.name + ".part")

    def run(self, url: str) -> None:
        """Download the file, unless it is there. ValueError if it has another hash."""
        known = self.part.with_name(self.part.name + ".etag")
        lock = self.part.with_name(self.part.name + ".lock")
        if self.path.is_file() and has_hash(self.path, self.known_hash):
            return
        with only_process(lock, f"{self.part}: another process is downloading it"):
            try:
                with self.part.open("ab") as file:
                    while not self._received(url, file, known):  # it is a part of another file
                        file.truncate(0)
                known.unlink(missing_ok=True)
                if not has_hash(self.part, self.known_hash):
                    self.part.unlink()
                    raise ValueError(f"the file must have the hash {self.known_hash}")
                os.replace(self.part, self.path)  # Windows moves no file that is open
            finally:
                if self.part.is_file() and not self.part.stat().st_size:
                    self.part.unlink()
                # A process that has opened the lock's file before finds that it is gone, and makes
                # a new one. On Windows, filelock deletes the file by itself.
                if sys.platform != "win32":
                    lock.unlink(missing_ok=True)

    def _received(self, url: str, file: BinaryIO, known: Path) -> bool:
        """Receive the rest of the file, or all of it.

        Returns: False if the file on the server ends before our part does.
        """
        start, headers = file.seek(0, os.SEEK_END), {"Accept-Encoding": "identity"}
        if start and known.is_file():
            headers["Range"] = f"bytes={start}-"
            headers["If-Range"] = known.read_text(encoding="latin-1")
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as answer:
            if answer.status_code == 416:
                return False
            answer.raise_for_status()
            if answer.status_code != 206:
                file.truncate(0)
            done = file.seek(0, os.SEEK_END)
            length = answer.headers.get("Content-Length")
            total = done + int(length) if length and length.isdigit() else None
            validator = answer.headers.get("ETag") or answer.headers.get("Last-Modified")
            if validator and not validator.startswith("W/"):
                known.write_text(validator, encoding="latin-1")
            else:
                known.unlink(missing_ok=True)
            for chunk in answer.iter_content(CHUNK):
                file.write(chunk)
                done += len(chunk)
                self.on_bytes(done, total)
            file.flush()
            if total is not None and done != total:
                raise requests.ConnectionError(f"{done} of {total} bytes came")
        return True


def has_hash(path: Path, known_hash: str | None) -> bool:
    """Whether a file has the hash "algorithm:digest"; any file has the hash None."""
    if known_hash is None:
        return True
    algorithm, _, digest = known_hash.partition(":")
    with path.open("rb") as file:
        return hashlib.file_digest(file, algorithm).hexdigest() == digest


def download(
    url: str, path: Path, *, known_hash: str | None, on_bytes: OnBytes = lambda _, __: None
) -> Path:
    """Download a file, unless it is there already with the right hash.

    Args:
      known_hash: "sha256:..." or "md5:..."; with None any content is accepted, and a file that is
        there already is kept.

    Returns: `path`.

    Raises:
      UserError: the file cannot be downloaded, cannot be written, or has another hash.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _Download(path, known_hash, on_bytes).run(url)
    except requests.RequestException as error:
        raise UserError(
            f"{url}: cannot be downloaded ({_reason(error)}); give the same command again, or "
            f"save the file yourself as {path}"
        ) from error
    except ValueError as error:
        raise UserError(
            f"{url}: the downloaded file does not have the hash {known_hash}; the transfer was "
            "damaged, or the file on the server has changed"
        ) from error
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


@contextlib.contextmanager
def progress_bar(label: str, *, shown: bool) -> Iterator[OnBytes]:
    """Show the progress of `download` as a bar."""
    with tqdm(desc=label, unit="B", unit_scale=True, disable=not shown) as bar:

        def on_bytes(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield on_bytes


def _reason(error: requests.RequestException) -> str:
    if isinstance(error, requests.HTTPError) and error.response is not None:
        return f"the server answers {error.response.status_code}"
    if isinstance(error, requests.Timeout):
        return "the server did not answer in time"
    if isinstance(error, requests.ConnectionError | requests.exceptions.ChunkedEncodingError):
        return "there is no connection, or it broke off"
    return type(error).__name__


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip archive into a folder, beside the files that are there.

    Nothing is written outside the folder. If the archive is damaged, UserError is raised and
    nothing is written.
    """
    scratch = tempfile.TemporaryDirectory(
        prefix=".unpacking-", dir=folder, ignore_cleanup_errors=True
    )
    with writing(folder), scratch as name:
        fresh = Path(name)
        try:
            with zipfile.ZipFile(archive) as opened:
                opened.extractall(fresh)  # zipfile removes ".." and roots from the names
        except _DAMAGED as error:
            raise UserError(f"{archive}: cannot be unpacked ({error})") from error
        for path in sorted(fresh.rglob("*")):
            target = folder / path.relative_to(fresh)
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                os.replace(path, target)
