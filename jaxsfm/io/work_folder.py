"""The folder a run owns: its lock, what it is a run of, its stages and its results."""

import contextlib
import fcntl
import json
import logging
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import PARTIAL, atomic_folder, read_json, write_atomic
from jaxsfm.io.hashes import rows_sha256, sha256_of
from jaxsfm.io.store import Identity, Store, digest

logger = logging.getLogger(__name__)

RECORD = "run.json"
"""The identity of the last run; says that a folder is one of ours."""
PAGE = "report.html"
"""Written after the other results, from them (`jaxsfm.report.page`)."""
RESULTS = (PAGE, "report.json", "sparse", "database.db")
_MOVES, _KEY = "moves.json", "key"


class WorkFolder(Store):
    """An open run folder; use `open_folder`."""

    # -- stages after matching -------------------------------------------------------------------

    def stage_folder(self, name: str) -> Path:
        """Where a stage's files lie."""
        return self.path / "stages" / name

    def stage(self, name: str, key: str) -> Path | None:
        """The folder of a finished stage, if it was made from what `key` says and is whole."""
        folder = self.stage_folder(name)
        try:
            found = (folder / _KEY).read_text(encoding="ascii")
            return folder if found == f"{key} {_content(folder)}" else None
        except (OSError, ValueError):
            return None

    @contextlib.contextmanager
    def record_stage(self, name: str, key: str) -> Iterator[Path]:
        """A folder for a stage's files; it takes the place of the former one when it is whole."""
        with atomic_folder(self.stage_folder(name)) as fresh:
            yield fresh
            (fresh / _KEY).write_text(f"{key} {_content(fresh)}", encoding="ascii")

    def forget_stage(self, name: str) -> None:
        """It is made again the next time."""
        (self.stage_folder(name) / _KEY).unlink(missing_ok=True)

    # -- results ---------------------------------------------------------------------------------

    @contextlib.contextmanager
    def publish(self) -> Iterator[Path]:
        """A folder for new results; when it is complete they replace the old ones together: killed
        on the way, the next run finishes that first.

        Results without a model do not replace results with one: they are left in `failed`.
        """
        fresh = self.path / "fresh"
        _remove(fresh)
        fresh.mkdir()
        yield fresh
        failed = (self.path / "sparse").exists() and not (fresh / "sparse").exists()
        if failed:
            logger.warning(
                "no model this time: the earlier one stays; this report is in %s",
                self.path / "failed",
            )
        moves = {"failed": failed, "names": [n for n in RESULTS if (fresh / n).exists()]}
        write_atomic(fresh / _MOVES, json.dumps(moves).encode())
        fresh.rename(self.path / "publishing")  # from here on they are the results
        self.finish_publishing()

    def finish_publishing(self) -> None:
        """Move complete results to where they belong, as far as that has not been done."""
        made = self.path / "publishing"
        moves = read_json(made / _MOVES)
        if not isinstance(moves, dict) or not isinstance(moves.get("names"), list):
            _remove(made)
            return
        target = self.path / "failed" if moves.get("failed") else self.path
        target.mkdir(exist_ok=True)
        for name in RESULTS:  # the report goes first and comes last: it never tells of other files
            if name not in moves["names"] or (made / name).exists():
                _remove(target / name)
        for name in reversed(RESULTS):
            if (made / name).exists():
                (made / name).rename(target / name)
        if target == self.path:
            _remove(self.path / "failed")  # of an earlier attempt
        (made / _MOVES).unlink()
        _remove(made)


def _content(folder: Path) -> str:
    """A digest of a stage's files: one that power failure tore is made again."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p != folder / _KEY)
    return digest([[p.relative_to(folder).as_posix(), _hash(p)] for p in files])


def _hash(file: Path) -> str:
    if file.suffix != ".db":
        return sha256_of(file)
    try:
        return rows_sha256(file)
    except sqlite3.DatabaseError as error:
        return f"damaged: {error}"


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


_OPTIONS = {
    name: f"--{name.replace('_', '-')}"
    for name in ("max_size", "keypoints", "convolutions", "backbone", "seed", "weights")
}


def differences(old: Identity, new: Identity) -> str:
    """What differs, in the user's terms; empty if nothing does."""
    parts = []
    for key in sorted(old.keys() | new.keys()):
        before, now = old.get(key), new.get(key)
        if before == now:
            continue
        if isinstance(before, dict) and isinstance(now, dict) and key == "images":
            changed = sorted(n for n in before.keys() | now.keys() if before.get(n) != now.get(n))
            parts.append(f"{len(changed)} images, first {changed[0]!r}")
        elif isinstance(before, dict) and isinstance(now, dict):
            parts.append(differences(before, now))
        else:
            parts.append(f"{_OPTIONS.get(key, key)}: {_short(before)} there, {_short(now)} now")
    return "; ".join(parts)


def _short(value: Any) -> Any:
    """Of a hash its first digits."""
    return f"{value[:8]}.." if isinstance(value, str) and len(value) == 64 else value


def _prepare(path: Path) -> TextIO:
    """Make the folder, or see that it is one of ours; its lock file, open."""
    try:
        if path.exists() and not path.is_dir():
            raise UserError(f"--out {path}: is a file, not a folder")
        if path.is_dir() and not (path / RECORD).exists():
            begun = {p for p in path.glob(f"{RECORD}.*{PARTIAL}")}
            strangers = sorted(p.name for p in {*path.iterdir()} - begun if p.name != ".lock")
            if strangers:
                raise UserError(
                    f"--out {path}: not empty and not a jaxsfm run (it holds {strangers[0]!r}); "
                    "choose an empty or new folder"
                )
        path.mkdir(parents=True, exist_ok=True)
        return (path / ".lock").open("w")
    except OSError as error:
        raise UserError(f"--out {path}: cannot be written ({error.strerror})") from error


def _former(path: Path) -> dict[str, Any] | None:
    """What the folder's last run was of; None for a new folder.

    Raises:
      UserError: nobody can tell.
    """
    record = path / RECORD
    if not record.exists():
        return None
    old = read_json(record)
    if not isinstance(old, dict) or not isinstance(old.get("images"), dict):
        raise UserError(
            f"--out {path}: holds another run, whose {RECORD} is damaged; "
            "choose another folder or delete this one"
        )
    return old


def _check_photos(path: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    """Refuse the folder of a run of other photos: its results would be replaced."""
    hashes = set(map(str, old["images"].values()))
    if hashes and not hashes & set(new["images"].values()):
        raise UserError(
            f"--out {path}: holds a run of other photos (first {min(old['images'])!r}); "
            "choose another folder or delete this one"
        )


@contextlib.contextmanager
def lock_folder(path: Path) -> Iterator[None]:
    """Create or find a run's folder, hold its lock, and finish what a killed run was publishing.

    Raises:
      UserError: a file, not a run's folder, not writable, or in use.
    """
    with _prepare(path) as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(f"--out {path}: another run is using this folder") from error
        try:
            WorkFolder(path, {}).finish_publishing()
        except OSError as error:
            raise UserError(f"--out {path}: cannot be written ({error.strerror})") from error
        yield


@contextlib.contextmanager
def open_folder(path: Path, identity: dict[str, Any]) -> Iterator[WorkFolder]:
    """Create or reopen a run's folder and hold its lock.

    What an earlier run in it was of may differ, but for photos of which none is left; that is said.

    Args:
      identity: what the matches depend on, as plain JSON (`jaxsfm.io.store`).

    Raises:
      UserError: a file, not writable, in use, or a run of other photos.
    """
    with lock_folder(path):
        yield open_locked_folder(path, identity)


def open_locked_folder(path: Path, identity: dict[str, Any]) -> WorkFolder:
    """As `open_folder`, by who holds the lock (`lock_folder`)."""
    new = json.loads(json.dumps(identity))
    old = _former(path)
    if old is not None:
        _check_photos(path, old, new)
        changed = differences(old, new)
        if changed:
            logger.info(
                "%s: the last run there differs (%s); what does not depend on that is used again",
                path,
                changed,
            )
        else:
            logger.info("continuing the run in %s", path)
    folder = WorkFolder(path, new)
    try:
        folder.sweep()
    except OSError as error:
        raise UserError(f"--out {path}: cannot be written ({error.strerror})") from error
    if old != new:
        write_atomic(path / RECORD, json.dumps(new, indent=1).encode())
    return folder
