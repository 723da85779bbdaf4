"""The work folder of a run: its lock, the record of what it is a run of, its stages, its results.

Commands that reconstruct or extend open it here; only one process at a time can. A stage is
computed once, and its files are kept under a key made of all that they depend on.
"""

import contextlib
import dataclasses
import json
import logging
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import (
    atomic_folder,
    only_process,
    rows_sha256,
    sha256_of,
    write_atomic,
)
from jaxsfm.io.entries import (
    DATABASE,
    FAILED,
    FRAMES,
    FRAMES_RECORD,
    FRESH,
    LOCK,
    LOGS,
    PARTIAL,
    PUBLISHING,
    RECORD,
    RESULTS,
    STAGES,
    VIEW_MASKS,
    VIEWS,
    VIEWS_RECORD,
    check_entries,
    entry,
    lock_file,
    named_place,
    remove,
)
from jaxsfm.io.store import Identity, Store, differences, digest
from jaxsfm.io.typed_files import read_json

logger = logging.getLogger(__name__)

_MOVES, _KEY = "moves.json", "key"


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Moves:
    """New results that are complete and have not all been moved into place."""

    failed: bool = False
    """Whether they are put into the folder `failed`."""
    names: list[str]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Photos:
    """The photos in the identity of a run."""

    images: dict[str, str]
    """Their SHA-256, by name."""


class WorkFolder(Store):
    """A work folder whose lock is held; `open_folder` makes one."""

    # -- stages after matching -------------------------------------------------------------------

    def stage(self, name: str, key: str, compute: Callable[[Path], None]) -> Path:
        """The folder with the files of a stage, which runs only if its files are not there yet.

        Args:
          key: identifies everything that the stage depends on.
          compute: runs the stage and writes its files into the given folder. They appear together,
            and replace those that were there.
        """
        folder = self._stage_folder(name)
        if _is_kept(folder, key):
            for database in folder.glob("*.db"):
                _make_own(database)
            logger.info("%s: as before, nothing it depends on has changed", name)
            return folder
        with writing(f"--out {self.path}"), atomic_folder(folder) as fresh:
            compute(fresh)
            (fresh / _KEY).write_text(f"{key} {_content(fresh)}", encoding="ascii")
        return folder

    def forget_stage(self, name: str) -> None:
        """Make the next run compute a stage again."""
        (self._stage_folder(name) / _KEY).unlink(missing_ok=True)

    def _stage_folder(self, name: str) -> Path:
        return entry(self.path, STAGES, name)

    def sweep(self) -> None:
        """Remove what a killed process had begun to write, and logs of databases, which are
        whole without them."""
        super().sweep()
        for end in LOGS:
            for log in entry(self.path, STAGES).glob(f"*/*{end}"):
                remove(log)

    # -- results ---------------------------------------------------------------------------------

    @contextlib.contextmanager
    def publish(self) -> Iterator[Path]:
        """Make a folder for new results; they replace the old ones together when the block ends.

        If the process is killed while it moves them, the next run moves the rest first. Results
        without a model do not replace results with one: they are put into the folder `failed`.
        """
        with writing(f"--out {self.path}"):
            fresh = entry(self.path, FRESH)
            remove(fresh)
            fresh.mkdir()
            yield fresh
            failed = (self.path / "sparse").exists() and not (fresh / "sparse").exists()
            if failed:
                logger.warning(
                    "this run made no model, so the earlier model stays; its report is in %s",
                    self.path / FAILED,
                )
            moves = {"failed": failed, "names": [n for n in RESULTS if (fresh / n).exists()]}
            write_atomic(fresh / _MOVES, json.dumps(moves).encode())
            fresh.rename(entry(self.path, PUBLISHING))  # from here on they are the results
            self.finish_publishing()

    def finish_publishing(self) -> None:
        """Move those of the complete results that have not been moved yet."""
        made = entry(self.path, PUBLISHING)
        moves = read_json(made / _MOVES, _Moves)
        if moves is None:
            remove(made)
            return
        target = entry(self.path, FAILED) if moves.failed else self.path
        target.mkdir(exist_ok=True)
        # The report is removed first and moved last, so that it never describes other files.
        for name in RESULTS:
            if name not in moves.names or (made / name).exists():
                remove(target / name)
                for end in LOGS if name == DATABASE else ():
                    remove(target / (name + end))
        for name in reversed(RESULTS):
            if (made / name).exists():
                (made / name).rename(target / name)
        if target == self.path:
            remove(entry(self.path, FAILED))  # left by an earlier attempt
        (made / _MOVES).unlink()
        remove(made)


def _make_own(database: Path) -> None:
    """Copy a database that has other names too (hard links), because COLMAP writes into it."""
    if database.stat().st_nlink > 1:
        copy = database.with_name(database.name + PARTIAL)
        remove(copy)
        shutil.copyfile(database, copy)
        os.replace(copy, database)


def _is_kept(folder: Path, key: str) -> bool:
    """Whether the files of a folder are whole and were made with this key."""
    try:
        found = (folder / _KEY).read_text(encoding="ascii")
        return found == f"{key} {_content(folder)}"
    except (OSError, ValueError):
        return False


def _content(folder: Path) -> str:
    """A digest of the files; it shows files that a power failure tore."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p != folder / _KEY)
    return digest([[p.relative_to(folder).as_posix(), _hash(p)] for p in files])


def _hash(file: Path) -> str:
    if file.suffix != ".db":
        return sha256_of(file)
    try:
        return rows_sha256(file)
    except sqlite3.DatabaseError as error:
        return f"damaged: {error}"


def _prepare(path: Path) -> None:
    """Make the folder, or check that it is a work folder."""
    with writing(f"--out {path}"):
        if path.exists() and not path.is_dir():
            raise UserError(f"--out {path}: this is a file and not a folder")
        if path.is_dir() and not (path / RECORD).exists():
            begun = {*path.glob(f"{RECORD}.*{PARTIAL}"), path / LOCK}
            if (path / LOCK).exists():
                begun |= {path / (name + PARTIAL) for name in (FRAMES, VIEWS, VIEW_MASKS)}
                begun.add(path / VIEW_MASKS)
            for name, made_of in ((FRAMES, FRAMES_RECORD), (VIEWS, VIEWS_RECORD)):
                if (path / name / made_of).is_file():
                    begun.add(path / name)
            strangers = sorted(p.name for p in {*path.iterdir()} - begun)
            if strangers:
                raise UserError(
                    f"--out {path}: the folder is not empty and not a jaxsfm run (it holds "
                    f"{strangers[0]!r}); choose an empty or new folder"
                )
        path.mkdir(parents=True, exist_ok=True)


def _former(path: Path) -> Identity | None:
    """The identity of the folder's last run; None if the folder is new."""
    record = path / RECORD
    if not record.exists():
        return None
    old = read_json(record, dict[str, Any]) or {}
    try:
        _images(old)
    except msgspec.ValidationError as error:
        raise UserError(
            f"--out {path}: the folder holds a run whose {RECORD} is damaged; "
            "choose another folder or delete this one"
        ) from error
    return old


def _check_photos(path: Path, old: Identity, new: Identity) -> None:
    """Refuse the folder of a run that shares no photo with this one.

    Otherwise the results of that run would be replaced.
    """
    before, now = _images(old), _images(new)
    if before and not {*before.values()} & {*now.values()}:
        raise UserError(
            f"--out {path}: the folder holds a run of other photos (first {min(before)!r}); "
            "choose another folder or delete this one"
        )


def _images(identity: Identity) -> dict[str, str]:
    return msgspec.convert(identity, _Photos).images


@contextlib.contextmanager
def lock_folder(path: Path) -> Iterator[None]:
    """Create or find a work folder and hold its lock while the block runs.

    If a run was killed while it moved its results into place, the rest is moved first. Raises
    UserError if `path` is a file or a folder of something else, cannot be written, is in use, or
    holds links (`jaxsfm.io.entries`).
    """
    named_place(path)
    _prepare(path)
    with contextlib.ExitStack() as stack:
        with writing(f"--out {path}"):
            in_use = f"--out {path}: another run is using this folder"
            stack.enter_context(only_process(lock_file(path), in_use))
            check_entries(path)
            WorkFolder(path, {}).finish_publishing()
        yield


@contextlib.contextmanager
def open_folder(path: Path, identity: Identity) -> Iterator[WorkFolder]:
    """Create or open a work folder and hold its lock while the block runs.

    An earlier run in the folder may have been made with other options or some other photos; the
    log says how it differs.

    Raises:
      UserError: the folder cannot be used (`lock_folder`), or the earlier run in it has no photo in
        common with this one.
    """
    with lock_folder(path):
        yield open_locked_folder(path, identity)


def open_locked_folder(path: Path, identity: Identity) -> WorkFolder:
    """Open a work folder whose lock the caller holds (`lock_folder`); else as `open_folder`."""
    new = json.loads(json.dumps(identity))
    old = _former(path)
    if old is not None:
        _check_photos(path, old, new)
        changed = differences(old, new)
        if changed:
            logger.info(
                "%s: the last run there differs (%s); what does not depend on this is used again",
                path,
                changed,
            )
        else:
            logger.info("continuing the run in %s", path)
    folder = WorkFolder(path, new)
    with writing(f"--out {path}"):
        folder.sweep()
    if old != new:
        write_atomic(path / RECORD, json.dumps(new, indent=1).encode())
    return folder
