"""Files from the network: resumed where they stopped, compared with their hash, unpacked safely."""

import contextlib
import fcntl
import lzma
import os
import shutil
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pooch
import requests
from tqdm import tqdm

from jaxsfm.errors import UserError

CHUNK = 1 << 16
TIMEOUT = (10, 60)
"""Seconds: to connect, and between two parts of a file."""
OnBytes = Callable[[int, int | None], None]
"""Told how many bytes there are by now, and how many there will be where the server says."""


_DAMAGED = (
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    RuntimeError,  # an encrypted zip; and what is not implemented
)


class _Resuming:
    """A downloader for pooch that goes on with what an earlier attempt left in FILE.part.

    The server's validator lies beside it: if the file has changed since, it starts again.
    """

    def __init__(self, part: Path, on_bytes: OnBytes) -> None:
        self.part, self.on_bytes = part, on_bytes

    def __call__(
        self, url: str, output_file: Any, pooch: Any, check_only: bool | None = False
    ) -> None:
        known = self.part.with_name(self.part.name + ".etag")
        with self.part.open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise UserError(f"{self.part}: another process is downloading it") from error
            try:
                while not self._received(url, file, known):  # what is there is of another file
                    file.truncate(0)
            except BaseException:
                if not file.seek(0, os.SEEK_END):
                    self.part.unlink()
                raise
            known.unlink(missing_ok=True)
            os.replace(self.part, output_file)

    def _received(self, url: str, file: Any, known: Path) -> bool:
        """Whether the rest came, or all of it; False: the server has nothing after our part."""
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


def download(
    url: str, path: Path, *, known_hash: str | None, on_bytes: OnBytes = lambda _, __: None
) -> Path:
    """The file at `url` as `path`; nothing is asked for where it is there already and right.

    Args:
      known_hash: "sha256:...", "md5:..."; None: any content will do, and what is there stays.

    Raises:
      UserError: it cannot be had, cannot be written, or has another hash.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        pooch.get_logger().disabled = True  # it would announce every file
        pooch.retrieve(
            url,
            known_hash,
            fname=path.name,
            path=path.parent,
            downloader=_Resuming(path.with_name(path.name + ".part"), on_bytes),  # pyright: ignore[reportArgumentType]
        )
    except requests.RequestException as error:
        raise UserError(
            f"{url}: cannot be downloaded ({_reason(error)}); the same command goes on from what "
            f"has come, or put the file there yourself: {path}"
        ) from error
    except ValueError as error:
        raise UserError(
            f"{url}: what came has another hash than {known_hash}; a damaged transfer, or the file "
            "there has changed"
        ) from error
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


@contextlib.contextmanager
def progress_bar(label: str, *, shown: bool) -> Iterator[OnBytes]:
    """What `download` tells, as a bar."""
    with tqdm(desc=label, unit="B", unit_scale=True, disable=not shown) as bar:

        def on_bytes(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield on_bytes


def _reason(error: requests.RequestException) -> str:
    if isinstance(error, requests.HTTPError) and error.response is not None:
        return f"the server answers {error.response.status_code}"
    if isinstance(error, requests.Timeout):
        return "no answer in time"
    if isinstance(error, requests.ConnectionError | requests.exceptions.ChunkedEncodingError):
        return "no connection, or it broke off"
    return type(error).__name__


def unpack(archive: Path, folder: Path) -> None:
    """A zip or tar archive into `folder`, beside what is there; nothing if it is damaged.

    Raises:
      UserError: it cannot be unpacked, or would write outside the folder.
    """
    fresh = Path(tempfile.mkdtemp(prefix=".unpacking-", dir=folder))
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as opened:
                opened.extractall(fresh)  # drops ".." and roots from names by itself
        else:
            with tarfile.open(archive) as opened:
                opened.extractall(fresh, filter="data")
        for path in sorted(fresh.rglob("*")):
            target = folder / path.relative_to(fresh)
            if path.is_dir():
                target.mkdir(exist_ok=True)
            else:
                os.replace(path, target)
    except _DAMAGED as error:
        raise UserError(f"{archive}: cannot be unpacked ({error})") from error
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
