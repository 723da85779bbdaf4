"""What a run has computed of its photos and pairs, each kept under all that it depends on.

So whatever changes between two runs in a folder (photos, options, weights, version), what does not
depend on it is found again, and nothing is ever taken for what it is not.
"""

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxsfm.config import EXTRACTED_BY
from jaxsfm.core.types import DenseFeatures, Status
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import PARTIAL, load_arrays, read_json, save_arrays, write_atomic
from jaxsfm.io.features import ImageFeatures
from jaxsfm.io.images import DamagedImage, ImageError, ImageFile
from jaxsfm.io.pairs import Pair, PairResult, describe

Identity = Mapping[str, Any]
"""What matches depend on, plain JSON: `version` of jaxsfm, `weights` and `relocalizer` (SHA-256),
`config` (`Config.matching`), `seed`, `images` (name -> SHA-256)."""

_OCTAVES = ("coarse", "fine")
"""Fields of DenseFeatures that hold an array per octave."""
_RESULT = ("cells", "keypoints0", "keypoints1", "plane", "homographies")
"""Arrays of a PairResult."""
_FOLDERS = ("features", "matches", "descriptors")


def digest(*parts: Any) -> str:
    """32 hexadecimal digits of plain JSON."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


class Store:
    """Features, matches and descriptors in a folder, one file each.

    Args:
      identity: of the run that they are read and written for.
    """

    def __init__(self, path: Path, identity: Identity) -> None:
        self.path, self.identity = path, identity

    def _file(self, kind: str, *depends_on: Any) -> Path:
        of_all = [self.identity.get(name) for name in ("version", "weights", "relocalizer")]
        name = digest(of_all, depends_on)
        return self.path / kind / name[:2] / f"{name[2:]}.npz"  # never 100 000 files in one folder

    def sweep(self) -> None:
        """Remove what a killed process had begun to write."""
        for kind in _FOLDERS:
            for partial in (self.path / kind).glob(f"*/*{PARTIAL}"):
                partial.unlink(missing_ok=True)
        for partial in self.path.glob(f"*.json.*{PARTIAL}"):
            partial.unlink(missing_ok=True)

    # -- features: needed until all pairs have matches -------------------------------------------

    def _feature_path(self, image: ImageFile) -> Path:
        config = self.identity.get("config", {})
        return self._file("features", {k: config.get(k) for k in EXTRACTED_BY}, image.sha256)

    def save_features(self, features: ImageFeatures) -> None:
        arrays = {"scale": np.asarray(features.scale, np.float64)}
        for name, value in features.dense._asdict().items():
            if name in _OCTAVES:
                arrays |= {f"octave{k}_{name}": array for k, array in enumerate(value)}
            else:
                arrays[name] = value
        save_arrays(self._feature_path(features.image), arrays)

    def has_features(self, image: ImageFile) -> bool:
        return self._feature_path(image).exists()

    def load_features(self, image: ImageFile) -> ImageFeatures | None:
        """The saved features, or None if there are none (or they are damaged)."""
        found: dict[str, Any] | None = load_arrays(self._feature_path(image))
        if found is None:
            return None
        octaves = sum(name.endswith("_coarse") for name in found)
        try:
            coarse, fine = (
                tuple(found[f"octave{k}_{name}"] for k in range(octaves)) for name in _OCTAVES
            )
            rest = (found[name] for name in DenseFeatures._fields if name not in _OCTAVES)
            dense = DenseFeatures(coarse, fine, *rest)
            x, y = found["scale"].tolist()
        except (KeyError, ValueError, TypeError):
            return None
        return ImageFeatures(image, (x, y), dense) if _are_features(dense, (x, y)) else None

    def drop_features(self) -> None:
        """Delete them, those of former options too: every pair has its matches."""
        shutil.rmtree(self.path / "features", ignore_errors=True)

    # -- descriptors of whole photos: small, kept ------------------------------------------------

    def save_descriptor(self, image: ImageFile, kind: str, arrays: Mapping[str, Any]) -> None:
        """Args:
        kind: what they are and all that they depend on beside the photo, weights and version.
        """
        save_arrays(self._file("descriptors", kind, image.sha256), arrays)

    def load_descriptor(self, image: ImageFile, kind: str) -> dict[str, np.ndarray] | None:
        """Saved arrays, or None if there are none (or they are damaged)."""
        return load_arrays(self._file("descriptors", kind, image.sha256))

    # -- photos that could not be decoded --------------------------------------------------------

    def _unusable(self) -> dict[str, str]:
        record = read_json(self.path / "unusable.json")
        return record if isinstance(record, dict) else {}

    def why_unusable(self, image: ImageFile) -> str | None:
        """Why an earlier attempt could not decode the photo."""
        reason = self._unusable().get(digest(self.identity.get("version"), image.sha256))
        return reason if isinstance(reason, str) else None

    def record_failure(self, image: ImageFile, error: ImageError) -> None:
        """What is damaged stays so; another failure may be over the next time."""
        if isinstance(error, DamagedImage):
            self.mark_unusable(image, str(error))

    def mark_unusable(self, image: ImageFile, reason: str) -> None:
        """Remember a photo that cannot be decoded, so that going on does not try again."""
        record = self._unusable() | {digest(self.identity.get("version"), image.sha256): reason}
        write_atomic(self.path / "unusable.json", json.dumps(record, indent=1).encode())

    # -- matches ---------------------------------------------------------------------------------

    def match_key(self, pair: Pair) -> str:
        """Of all that a pair's matches depend on."""
        return self._match_path(pair).stem

    def _match_path(self, pair: Pair) -> Path:
        known = self.identity.get("images", {})
        hashes = [known.get(name) for name in pair]
        return self._file("matches", self.identity.get("config"), self.identity.get("seed"), hashes)

    def save_matches(self, result: PairResult) -> None:
        arrays = {name: getattr(result, name) for name in _RESULT}
        counts = [result.num_tentative, result.num_dropped, int(result.status)]
        save_arrays(
            self._match_path(result.pair), {**arrays, "counts": np.asarray(counts, np.int64)}
        )

    def load_matches(self, pair: Pair) -> PairResult | None:
        """The saved matches, or None if there are none (or they are damaged)."""
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


def _is(array: Any, dtype: type, *shape: int) -> bool:
    return array.dtype == dtype and array.shape == shape and bool(np.isfinite(array).all())


def _are_matches(found: PairResult) -> bool:
    """Whether a pair's result is one that COLMAP takes: a file of other arrays is damaged."""
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
    """Whether arrays are features by shape and type; of descriptors the values are not looked at,
    whose checksums are right (they are 25 MB)."""
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


class SavedMatches(Mapping[Pair, PairResult]):
    """Pairs' results in a folder, read when they are asked for."""

    def __init__(self, store: Store, pairs: Iterable[Pair]) -> None:
        self._store, self._pairs = store, dict.fromkeys(pairs)

    def __getitem__(self, pair: Pair) -> PairResult:
        if pair not in self._pairs:
            raise KeyError(pair)
        found = self._store.load_matches(pair)
        if found is None:
            raise UserError(
                f"--out {self._store.path}: the matches of {describe(pair)} are gone or damaged; "
                "run the same command again"
            )
        return found

    def __contains__(self, pair: object) -> bool:
        return pair in self._pairs

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)
