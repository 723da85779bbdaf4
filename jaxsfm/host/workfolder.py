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
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.errors import UserError
from jaxsfm.host.features import ImageFeatures
from jaxsfm.host.images import ImageFile
from jaxsfm.host.pairs import Pair, PairResult

logger = logging.getLogger(__name__)

MEMORY_BYTES = 2 << 30
"""Features kept in memory; the others are read again from the folder."""
_DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that is either whole or absent."""
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(data)
    os.replace(partial, path)


def _save_npz(path: Path, arrays: dict[str, Any]) -> None:
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(partial, path)


class WorkFolder:
    """An open run folder; use `open_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._cache: OrderedDict[str, ImageFeatures] = OrderedDict()

    # -- features: a cache that may be deleted at any time -------------------------------------

    def _feature_path(self, image: ImageFile) -> Path:
        return self.path / "features" / f"{image.sha256[:32]}.npz"

    def save_features(self, features: ImageFeatures) -> None:
        arrays = {**features.dense._asdict(), "scale": np.asarray(features.scale, np.float64)}
        path = self._feature_path(features.image)
        path.parent.mkdir(exist_ok=True)
        _save_npz(path, arrays)
        self._remember(features)

    def has_features(self, image: ImageFile) -> bool:
        return image.name in self._cache or self._feature_path(image).exists()

    def load_features(self, image: ImageFile) -> ImageFeatures | None:
        """The saved features, or None if there are none (or they are damaged)."""
        if image.name in self._cache:
            self._cache.move_to_end(image.name)
            return self._cache[image.name]
        try:
            with np.load(self._feature_path(image), allow_pickle=False) as file:
                dense = DenseFeatures(*(file[name] for name in DenseFeatures._fields))
                scale = file["scale"]
        except _DAMAGED:
            return None
        features = ImageFeatures(image, (float(scale[0]), float(scale[1])), dense)
        self._remember(features)
        return features

    def _remember(self, features: ImageFeatures) -> None:
        self._cache[features.image.name] = features
        sizes = {name: sum(a.nbytes for a in f.dense) for name, f in self._cache.items()}
        total = sum(sizes.values())
        while total > MEMORY_BYTES and len(self._cache) > 2:
            name, _ = self._cache.popitem(last=False)
            total -= sizes[name]

    def drop_features(self) -> None:
        """Delete the cache: every pair has its matches."""
        self._cache.clear()
        shutil.rmtree(self.path / "features", ignore_errors=True)

    # -- matches ---------------------------------------------------------------------------------

    def _match_path(self, pair: Pair) -> Path:
        digest = hashlib.sha256("\0".join(pair).encode(errors="surrogateescape")).hexdigest()
        return self.path / "matches" / f"{digest[:32]}.npz"

    def save_matches(self, result: PairResult) -> None:
        path = self._match_path(result.pair)
        path.parent.mkdir(exist_ok=True)
        _save_npz(
            path,
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
            with np.load(self._match_path(pair), allow_pickle=False) as file:
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


def _differences(old: dict[str, Any], new: dict[str, Any]) -> str:
    parts = []
    for key in sorted(old.keys() | new.keys()):
        if old.get(key) != new.get(key):
            if key == "images":
                before, now = old.get(key, {}), new.get(key, {})
                changed = sorted(
                    n for n in before.keys() | now.keys() if before.get(n) != now.get(n)
                )
                parts.append(f"{len(changed)} images, first {changed[0]!r}")
            else:
                parts.append(f"{key}: {old.get(key)} there, {new.get(key)} now")
    return "; ".join(parts)


@contextlib.contextmanager
def open_folder(path: Path, identity: dict[str, Any]) -> Iterator[WorkFolder]:
    """Create or reopen a run's folder and hold its lock.

    Args:
      identity: what the matches depend on (images, options, weights, version), as plain JSON.

    Raises:
      UserError: a file, not writable, in use, or another run's.
    """
    identity = json.loads(json.dumps(identity))
    if path.exists() and not path.is_dir():
        raise UserError(f"--out {path}: is a file, not a folder")
    record = path / "run.json"
    try:
        if path.is_dir() and not record.exists():
            strangers = sorted(p.name for p in path.iterdir() if p.name != ".lock")
            if strangers:
                raise UserError(
                    f"--out {path}: not empty and not a jaxsfm run (it holds {strangers[0]!r}); "
                    "choose an empty or new folder"
                )
        path.mkdir(parents=True, exist_ok=True)
        lock = (path / ".lock").open("w")
    except OSError as error:
        raise UserError(f"--out {path}: cannot be written ({error.strerror})") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(f"--out {path}: another run is using this folder") from error
        try:
            if record.exists():
                try:
                    old = json.loads(record.read_text(encoding="utf-8"))
                except ValueError:
                    old = {}
                if old != identity:
                    raise UserError(
                        f"--out {path}: holds another run ({_differences(old, identity)}); "
                        "choose another folder or delete this one"
                    )
                logger.info("continuing the run in %s", path)
            else:
                write_atomic(record, json.dumps(identity, indent=1).encode())
            yield WorkFolder(path)
        except OSError as error:
            raise UserError(f"--out {path}: cannot be written ({error.strerror})") from error
