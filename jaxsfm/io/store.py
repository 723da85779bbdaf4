"""The features and matches of a run are kept in files that are named by what they depend on.

A later run in the same folder may have other photos, options or weights. It finds again whatever
does not depend on the change, and it never takes a file for something else.
"""

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Array

from jaxsfm.config import EXTRACTED_BY
from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json, load_arrays, save_arrays, write_atomic
from jaxsfm.io.entries import (
    DESCRIPTORS,
    FAILED,
    FEATURES,
    MATCHES,
    PARTIAL,
    UNUSABLE,
    entry,
)
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import DamagedImage, ImageError, ImageFile, content
from jaxsfm.io.orientation import checked
from jaxsfm.io.pairs import LazyMatches, Pair, PairResult, describe
from jaxsfm.io.typed_files import read_json

Identity = Mapping[str, Json]
"""What the matches of a run depend on: `version` of jaxsfm, `weights` and `relocalizer` (SHA-256),
`config` (`Config.matching`), `seed`, `images` (name -> SHA-256), `orientations` of those that are
not stored upright (name -> code of `jaxsfm.io.orientation`), and `masks` (name of the photo ->
SHA-256)."""

_OCTAVES = ("coarse", "fine")
"""The fields of DenseFeatures that hold one array for each octave."""
_RESULT = ("cells", "keypoints0", "keypoints1", "plane", "homographies")
"""The fields of PairResult that are arrays."""
_FOLDERS = (FEATURES, MATCHES, DESCRIPTORS)


def digest(*parts: Json) -> str:
    """Return 32 hexadecimal digits of the SHA-256 of values that JSON can hold."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


_OPTIONS = {
    name: f"--{name.replace('_', '-')}"
    for name in (
        "max_size",
        "keypoints",
        "convolutions",
        "products",
        "backbone",
        "seed",
        "weights",
    )
}


def differences(old: Identity, new: Identity) -> str:
    """Say in the user's terms how two identities differ; "" if they do not."""
    parts = []
    for key in sorted(old.keys() | new.keys()):
        before, now = old.get(key), new.get(key)
        if before == now:
            continue
        if isinstance(before, dict) and isinstance(now, dict) and key == "images":
            changed = sorted(n for n in before.keys() | now.keys() if before.get(n) != now.get(n))
            parts.append(f"{len(changed)} images, first {changed[0]!r}")
        elif key in ("orientations", "masks"):
            parts.append({"orientations": "how images are turned", "masks": "--masks"}[key])
        elif isinstance(before, dict) and isinstance(now, dict):
            parts.append(differences(before, now))
        else:
            parts.append(f"{_OPTIONS.get(key, key)}: {_short(before)} there, {_short(now)} now")
    return "; ".join(parts)


def _short(value: Json) -> Json:
    """The first digits of a value that is a hash; any other value as it is."""
    return f"{value[:8]}.." if isinstance(value, str) and len(value) == 64 else value


class Store:
    """Features, matches and descriptors in a folder, each in its own file.

    The identity says what the run depends on. It decides which files belong to the run.
    """

    def __init__(self, path: Path, identity: Identity) -> None:
        self.path, self.identity = path, identity

    def _file(self, kind: str, *depends_on: Json) -> Path:
        common = [self.identity.get(name) for name in ("version", "weights", "relocalizer")]
        name = digest(common, depends_on)
        # The sub-folders keep a run of 100 000 pairs from having as many files in one folder.
        return self.path / kind / name[:2] / f"{name[2:]}.safetensors"

    def _save(self, path: Path, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a file of the store; UserError if it cannot be written, or a link leads to it."""
        kind, folder, _ = path.relative_to(self.path).parts
        entry(self.path, kind, folder)
        save_arrays(path, arrays)

    def _setting(self, name: str) -> Mapping[str, Json]:
        """An entry of the identity that is an object, or {} if it is none."""
        value = self.identity.get(name)
        return value if isinstance(value, Mapping) else {}

    def sweep(self) -> None:
        """Remove the files that a killed process had begun to write."""
        for kind in _FOLDERS:
            for partial in entry(self.path, kind).glob(f"*/*{PARTIAL}"):
                partial.unlink(missing_ok=True)
        for folder in (self.path, entry(self.path, FAILED)):
            for partial in folder.glob(f"*.*.*{PARTIAL}"):  # NAME.SUFFIX.PROCESS.partial
                partial.unlink(missing_ok=True)

    # -- features: they are needed until all pairs have matches ----------------------------------

    def _feature_path(self, image: ImageFile) -> Path:
        config = self._setting("config")
        return self._file(FEATURES, {k: config.get(k) for k in EXTRACTED_BY}, image.content)

    def save_features(self, features: ImageFeatures) -> None:
        """Save the features of an image. Raises UserError if they cannot be written."""
        arrays = {"scale": np.asarray(features.scale, np.float64)}
        for name, value in features.dense._asdict().items():
            if name in _OCTAVES:
                arrays |= {f"octave{k}_{name}": array for k, array in enumerate(value)}
            else:
                arrays[name] = value
        self._save(self._feature_path(features.image), arrays)

    def has_features(self, image: ImageFile) -> bool:
        """Whether features of the image are saved; the file may still be damaged."""
        return self._feature_path(image).exists()

    def load_features(self, image: ImageFile) -> ImageFeatures | None:
        """The saved features of an image, or None if the file is missing or damaged."""
        found = load_arrays(self._feature_path(image))
        if found is None:
            return None
        octaves = sum(name.endswith("_coarse") for name in found)
        try:
            coarse, fine = (
                tuple(found[f"octave{k}_{name}"] for k in range(octaves)) for name in _OCTAVES
            )
            rest = (found[name] for name in DenseFeatures._fields if name not in _OCTAVES)
            dense = DenseFeatures(coarse, fine, *rest)  # pyright: ignore[reportArgumentType]
            x, y = found["scale"].tolist()
        except (KeyError, ValueError, TypeError):
            return None
        return ImageFeatures(image, (x, y), dense) if _are_features(dense, (x, y)) else None

    def drop_features(self) -> None:
        """Delete all features, also those of earlier options.

        A run calls this when every pair has its matches.
        """
        shutil.rmtree(entry(self.path, FEATURES), ignore_errors=True)

    # -- descriptors of whole photos: they are small and stay ------------------------------------

    def save_descriptor(self, image: ImageFile, kind: str, array: np.ndarray) -> None:
        """Save the array that describes a photo as a whole; UserError if it cannot be written.

        Args:
          kind: the name of the description, followed by all that it depends on besides the photo,
            the weights and jaxsfm's version.
        """
        self._save(self._file(DESCRIPTORS, kind, image.content), {"array": array})

    def load_descriptor(self, image: ImageFile, kind: str) -> np.ndarray | None:
        """The array that was saved, or None if the file is missing or damaged."""
        return (load_arrays(self._file(DESCRIPTORS, kind, image.content)) or {}).get("array")

    # -- photos that could not be decoded --------------------------------------------------------

    def _unusable(self) -> dict[str, str]:
        return read_json(self.path / UNUSABLE, dict[str, str]) or {}

    def why_unusable(self, image: ImageFile) -> str | None:
        """The reason why an earlier run could not decode the photo; None if there is none."""
        return self._unusable().get(digest(self.identity.get("version"), image.sha256))

    def record_failure(self, image: ImageFile, error: ImageError) -> None:
        """Remember a photo that is damaged, so that later runs skip it.

        Other failures are not remembered, because the next attempt may succeed.
        """
        if not isinstance(error, DamagedImage):
            return
        key = digest(self.identity.get("version"), image.sha256)
        record = self._unusable() | {key: str(error)}
        write_atomic(entry(self.path, UNUSABLE), json.dumps(record, indent=1).encode())

    # -- matches ---------------------------------------------------------------------------------

    def match_key(self, pair: Pair) -> str:
        """A digest of all that the matches of a pair depend on."""
        return self._match_path(pair).stem

    def _match_path(self, pair: Pair) -> Path:
        images = self._setting("images")
        turned, masks = self._setting("orientations"), self._setting("masks")
        contents = [
            content(str(images.get(name)), checked(turned.get(name)), _text(masks.get(name)))
            for name in pair
        ]
        return self._file(MATCHES, self.identity.get("config"), self.identity.get("seed"), contents)

    def save_matches(self, result: PairResult) -> None:
        """Save the matches of a pair. Raises UserError if they cannot be written."""
        arrays = {name: getattr(result, name) for name in _RESULT}
        counts = [result.num_tentative, result.num_dropped, int(result.status)]
        self._save(
            self._match_path(result.pair), {**arrays, "counts": np.asarray(counts, np.int64)}
        )

    def load_matches(self, pair: Pair) -> PairResult | None:
        """The saved matches of a pair, or None if the file is missing or damaged."""
        found = load_arrays(self._match_path(pair))
        try:
            if found is None:
                return None
            tentative, dropped, status = found["counts"].tolist()
            result = PairResult(
                pair=pair,
                **{name: found[name] for name in _RESULT},
                num_tentative=tentative,
                num_dropped=dropped,
                status=Status(status),
            )
        except (KeyError, ValueError, TypeError):
            return None
        return result if _are_matches(result) else None


class SavedMatches(LazyMatches):
    """The matches of pairs, read from their files when they are asked for.

    Reading raises UserError if a file is missing or damaged.
    """

    def __init__(self, store: Store, pairs: Iterable[Pair]) -> None:
        super().__init__(pairs)
        self._store = store

    def _load(self, pair: Pair) -> PairResult:
        found = self._store.load_matches(pair)
        if found is None:
            raise UserError(
                f"--out {self._store.path}: matches of {describe(pair)} are missing or "
                "damaged, so run the same command again"
            )
        return found


def _text(value: Json) -> str | None:
    return value if isinstance(value, str) else None


def _is(array: Array | np.ndarray, dtype: type, *shape: int) -> bool:
    """Whether an array has this dtype and this shape, and only finite values."""
    return array.dtype == dtype and array.shape == shape and bool(np.isfinite(array).all())


def _are_matches(found: PairResult) -> bool:
    """Whether the arrays are matches that COLMAP accepts; if not, the file was damaged."""
    n, planes = len(found.plane.ravel()), len(np.atleast_1d(found.homographies))
    return (
        all(type(v) is int and v >= 0 for v in (found.num_tentative, found.num_dropped))
        and _is(found.cells, np.int32, n, 2)
        and bool((found.cells >= 0).all())
        and all(len(np.unique(column)) == n for column in found.cells.T)
        and _is(found.keypoints0, np.float32, n, 2)
        and _is(found.keypoints1, np.float32, n, 2)
        and _is(found.homographies, np.float64, planes, 3, 3)
        and _is(found.plane, np.int32, n)
        and bool(((found.plane >= 0) & (found.plane < planes)).all())
    )


def _are_features(dense: DenseFeatures, scale: tuple[float, float]) -> bool:
    """Whether the arrays are features, judged by their shapes and dtypes.

    The values of descriptors are not looked at: they take 25 MB, and their checksums are right.
    """
    every = (*dense.coarse, *dense.fine)
    if not dense.coarse or any(a.ndim != 2 or a.dtype != every[0].dtype for a in every):
        return False
    cells = len(dense.fine[0])
    grids = (dense.coarse_grid, dense.fine_grid)
    return (
        all(type(v) is float and 0 < v < np.inf for v in scale)
        and every[0].dtype in (np.float16, np.float32)
        and all(len({a.shape[1] for a in octaves}) == 1 for octaves in (dense.coarse, dense.fine))
        and _is(dense.keypoints, np.float32, cells, 2)
        and all(_is(grid, np.int32, 2) and bool((grid > 0).all()) for grid in grids)
        and int(dense.coarse_grid.prod(dtype=np.int64)) <= len(dense.coarse[0])
        and int(dense.fine_grid.prod(dtype=np.int64)) <= cells
    )
