"""The folder a run owns: what it is a run of, its lock, features and matches.

Files appear whole or not at all (written beside, then renamed). A match file holds one pair; a run
that was interrupted finds its own files again and goes on. A folder that holds another run is
refused, never overwritten.
"""

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np

from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.errors import UserError
from jaxsfm.host.features import ImageFeatures
from jaxsfm.host.images import ImageFile
from jaxsfm.host.pairs import Pair, PairResult, describe

logger = logging.getLogger(__name__)

_OCTAVES = ("coarse", "fine")
"""Fields of DenseFeatures that hold an array per octave."""
PAGE = "report.html"
"""Written after the other results, from them (`jaxsfm.page`)."""
RESULTS = (PAGE, "report.json", "sparse", "database.db")
_DAMAGED = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that appears whole or not at all.

    Raises:
      UserError: it cannot be written (permission, disk full).
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            yield file
        os.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that is either whole or absent."""
    with atomic_file(path) as file:
        file.write(data)


def _save_npz(path: Path, arrays: dict[str, Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    with atomic_file(path) as file:
        np.savez(file, **arrays)


class WorkFolder:
    """An open run folder; use `open_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    # -- features: a cache that may be deleted at any time -------------------------------------

    def _feature_path(self, image: ImageFile) -> Path:
        return self.path / "features" / f"{image.sha256[:32]}.npz"

    def save_features(self, features: ImageFeatures) -> None:
        arrays = {"scale": np.asarray(features.scale, np.float64)}
        for name, value in features.dense._asdict().items():
            if name in _OCTAVES:
                arrays |= {f"octave{k}_{name}": array for k, array in enumerate(value)}
            else:
                arrays[name] = value
        _save_npz(self._feature_path(features.image), arrays)

    def has_features(self, image: ImageFile) -> bool:
        return self._feature_path(image).exists()

    def load_features(self, image: ImageFile) -> ImageFeatures | None:
        """The saved features, or None if there are none (or they are damaged)."""
        try:
            with (
                self._feature_path(image).open("rb") as raw,
                np.load(raw, allow_pickle=False) as file,
            ):
                octaves = sum(name.endswith("_coarse") for name in file)
                coarse, fine = (
                    tuple(file[f"octave{k}_{name}"] for k in range(octaves)) for name in _OCTAVES
                )
                rest = (file[name] for name in DenseFeatures._fields if name not in _OCTAVES)
                dense = DenseFeatures(coarse, fine, *rest)
                scale = file["scale"]
        except _DAMAGED:
            return None
        return ImageFeatures(image, (float(scale[0]), float(scale[1])), dense)

    def drop_features(self) -> None:
        """Delete the cache: every pair has its matches."""
        shutil.rmtree(self.path / "features", ignore_errors=True)

    # -- photos that could not be decoded ------------------------------------------------------

    def unusable(self) -> dict[str, str]:
        """SHA-256 -> reason of the photos an earlier attempt could not decode."""
        try:
            record = json.loads((self.path / "unusable.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}

    def mark_unusable(self, image: ImageFile, reason: str) -> None:
        """Remember a photo that cannot be decoded, so that going on does not try again."""
        record = {**self.unusable(), image.sha256: reason}
        write_atomic(self.path / "unusable.json", json.dumps(record, indent=1).encode())

    # -- results ---------------------------------------------------------------------------------

    @contextlib.contextmanager
    def publish(self) -> Iterator[Path]:
        """A folder for new results; when it is complete they replace the old ones together.

        Results without a model do not replace results with one: they are left in `failed`.
        """
        fresh = self.path / "fresh"
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir()
        yield fresh
        target = self.path
        if (self.path / "sparse").exists() and not (fresh / "sparse").exists():
            target = self.path / "failed"
            logger.warning(
                "no model this time: the earlier one stays; this report is in %s", target
            )
            target.mkdir(exist_ok=True)
        for name in RESULTS:  # the report goes first and comes last: it never tells of other files
            old = target / name
            if old.is_dir():
                shutil.rmtree(old)
            else:
                old.unlink(missing_ok=True)
        for name in reversed(RESULTS):
            if (fresh / name).exists():
                (fresh / name).rename(target / name)
        fresh.rmdir()

    # -- matches ---------------------------------------------------------------------------------

    def _match_path(self, pair: Pair) -> Path:
        digest = hashlib.sha256("\0".join(pair).encode(errors="surrogateescape")).hexdigest()
        return self.path / "matches" / f"{digest[:32]}.npz"

    def save_matches(self, result: PairResult) -> None:
        _save_npz(
            self._match_path(result.pair),
            {
                "cells": result.cells,
                "keypoints0": result.keypoints0,
                "keypoints1": result.keypoints1,
                "plane": result.plane,
                "homographies": result.homographies,
                "counts": np.asarray(
                    [result.num_tentative, result.num_dropped, int(result.status)], np.int64
                ),
            },
        )

    def load_matches(self, pair: Pair) -> PairResult | None:
        """The saved matches, or None if there are none (or they are damaged)."""
        try:
            with self._match_path(pair).open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                tentative, dropped, status = (int(v) for v in file["counts"])
                return PairResult(
                    pair=pair,
                    cells=file["cells"],
                    keypoints0=file["keypoints0"],
                    keypoints1=file["keypoints1"],
                    plane=file["plane"],
                    homographies=file["homographies"],
                    num_tentative=tentative,
                    num_dropped=dropped,
                    status=Status(status),
                )
        except _DAMAGED:
            return None


class SavedMatches(Mapping[Pair, PairResult]):
    """Pairs' results in a folder, read when they are asked for."""

    def __init__(self, folder: WorkFolder, pairs: Iterable[Pair]) -> None:
        self._folder, self._pairs = folder, dict.fromkeys(pairs)

    def __getitem__(self, pair: Pair) -> PairResult:
        if pair not in self._pairs:
            raise KeyError(pair)
        found = self._folder.load_matches(pair)
        if found is None:
            raise UserError(
                f"--out {self._folder.path}: the matches of {describe(pair)} are gone or damaged; "
                "run the same command again"
            )
        return found

    def __contains__(self, pair: object) -> bool:
        return pair in self._pairs

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)


_OPTIONS = {
    name: f"--{name.replace('_', '-')}"
    for name in ("max_size", "keypoints", "convolutions", "seed")
}


def _differences(old: dict[str, Any], new: dict[str, Any]) -> str:
    """What differs, in the user's terms."""
    parts = []
    for key in sorted(old.keys() | new.keys()):
        before, now = old.get(key), new.get(key)
        if before == now:
            continue
        if isinstance(before, dict) and isinstance(now, dict) and key == "images":
            changed = sorted(n for n in before.keys() | now.keys() if before.get(n) != now.get(n))
            parts.append(f"{len(changed)} images, first {changed[0]!r}")
        elif isinstance(before, dict) and isinstance(now, dict):
            parts.append(_differences(before, now))
        else:
            parts.append(f"{_OPTIONS.get(key, key)}: {before} there, {now} now")
    return "; ".join(parts)


def _prepare(path: Path) -> TextIO:
    """Make the folder, or see that it is one of ours; its lock file, open."""
    try:
        if path.exists() and not path.is_dir():
            raise UserError(f"--out {path}: is a file, not a folder")
        if path.is_dir() and not (path / "run.json").exists():
            ours = {".lock", "run.json.partial"}
            strangers = sorted(p.name for p in path.iterdir() if p.name not in ours)
            if strangers:
                raise UserError(
                    f"--out {path}: not empty and not a jaxsfm run (it holds {strangers[0]!r}); "
                    "choose an empty or new folder"
                )
        path.mkdir(parents=True, exist_ok=True)
        return (path / ".lock").open("w")
    except OSError as error:
        raise UserError(f"--out {path}: cannot be written ({error.strerror})") from error


def _check_identity(path: Path, identity: dict[str, Any]) -> None:
    """Record what the run is of, or refuse a folder whose record says otherwise."""
    record = path / "run.json"
    if not record.exists():
        write_atomic(record, json.dumps(identity, indent=1).encode())
        return
    try:
        old = json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        old = None
    if not isinstance(old, dict):
        raise UserError(
            f"--out {path}: holds another run, whose run.json is damaged; "
            "choose another folder or delete this one"
        )
    if old != identity:
        raise UserError(
            f"--out {path}: holds another run ({_differences(old, identity)}); "
            "choose another folder or delete this one"
        )
    logger.info("continuing the run in %s", path)


@contextlib.contextmanager
def open_folder(path: Path, identity: dict[str, Any]) -> Iterator[WorkFolder]:
    """Create or reopen a run's folder and hold its lock.

    Args:
      identity: what the matches depend on (images, options, weights, version), as plain JSON.

    Raises:
      UserError: a file, not writable, in use, or another run's.
    """
    with _prepare(path) as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(f"--out {path}: another run is using this folder") from error
        _check_identity(path, json.loads(json.dumps(identity)))
        yield WorkFolder(path)
