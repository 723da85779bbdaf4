"""Reads and writes hloc's features and matches (HDF5) and its pair lists.

Layout (hloc/extract_features.py, match_features.py, utils/io.py, utils/parsers.py):

* features: group NAME (with '/' a group in a group): `keypoints` (n, 2), (x, y) of the original
  image, centre of the top-left pixel (0, 0), attribute `uncertainty` in pixels; `image_size`
  (width, height).
* matches: group NAME0/NAME1, each name's '/' turned into '-' (older files: NAME0_NAME1): `matches0`
  (n0,), the second image's keypoint or -1, and `matching_scores0` (n0,).
* pairs: a text file, two names a line, cut at blanks.

hloc writes matches as int16, in which indices above 32767 turn negative, and keypoints as float16,
which rounds to half a pixel beyond 512 and to one beyond 1024. hloc reads any integers and floats,
so int32 and float32 are written here.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from jaxsfm.colmap.formats.tables import (
    MAX_KEYPOINTS,
    Tables,
    check_no_blanks,
    checked_keypoints,
    checked_matches,
)
from jaxsfm.errors import UserError
from jaxsfm.io.extras import extra
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe

with extra("hdf5", "reading and writing HDF5 files needs"):
    import h5py

FEATURES, MATCHES, PAIRS = "features.h5", "matches.h5", "pairs.txt"
MAX_COLUMNS = 16
"""Columns of a keypoint. A file that claims more is damaged."""
# h5py raises various errors for damaged files, SystemError if a read fails half-way.
DAMAGED = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, SystemError)


def pair_key(name0: str, name1: str) -> str:
    """The name of the group that holds a pair's matches."""
    return f"{name0.replace('/', '-')}/{name1.replace('/', '-')}"


def write_hloc(
    folder: Path,
    tables: Tables,
    matches: Mapping[Pair, np.ndarray],
    uncertainty_px: Mapping[str, float],
) -> None:
    """Write features, matches and the list of pairs, as hloc's mapping reads them.

    All matches get the score 1, because they are inliers of RANSAC without scores of their own.

    Args:
      matches: those of `tables.matches` or `tables.inliers` to write.
      uncertainty_px: by image name, uncertainty of its keypoints, original pixels.

    Raises:
      UserError: hloc's files cannot tell two names apart, or a name has a blank in it.
    """
    _check_names(tables.sizes)
    with h5py.File(folder / FEATURES, "w", libver="latest") as file:
        for name, size in sorted(tables.sizes.items()):
            group = file.create_group(name)
            xy = tables.keypoints.get(name, np.zeros((0, 2), np.float32))
            keypoints = group.create_dataset("keypoints", data=xy)
            keypoints.attrs["uncertainty"] = uncertainty_px[name]
            group.create_dataset("image_size", data=np.asarray(size, np.int64))
    with h5py.File(folder / MATCHES, "w", libver="latest") as file:
        for (name0, name1), rows in sorted(matches.items()):
            second = np.full(len(tables.keypoints[name0]), -1, np.int32)
            second[rows[:, 0]] = rows[:, 1]
            group = file.create_group(pair_key(name0, name1))
            group.create_dataset("matches0", data=second)
            group.create_dataset("matching_scores0", data=(second >= 0).astype(np.float16))
    lines = "".join(f"{a} {b}\n" for a, b in sorted(matches))
    (folder / PAIRS).write_text(lines, encoding="utf-8", newline="\n")


def _check_names(names: Iterable[str]) -> None:
    check_no_blanks(names, "hloc")
    shortened = Counter(name.replace("/", "-") for name in names)
    for name in names:
        if shortened[name.replace("/", "-")] > 1:
            raise UserError(
                f"--to hloc: {shown_name(name)} and another image have one name in hloc's matches, "
                "which turn / into -"
            )


def dataset(group: h5py.Group, key: str, where: str, max_rows: int) -> np.ndarray:
    """The numbers of a data set; UserError if there are none, or more than a file can have."""
    found = group.get(key)
    if not isinstance(found, h5py.Dataset) or found.dtype.kind not in "fiu":
        raise UserError(f"{where}: no numbers {key!r}")
    columns = found.shape[1] if found.ndim == 2 else 1
    if not 1 <= found.ndim <= 2 or found.shape[0] > max_rows or columns > MAX_COLUMNS:
        raise UserError(f"{where}: {key} has the shape {found.shape}")
    return np.asarray(found)


def pairs_in(
    file: h5py.Group, names: Mapping[str, str], holds: str
) -> Iterator[tuple[str, str, h5py.Group]]:
    """Find every pair of known images, and its group.

    Args:
      names: shortened name -> name.
      holds: a data set that the group of a pair has.
    """
    for key, group in file.items():
        if not isinstance(group, h5py.Group):
            continue
        if holds in group:  # the older layout
            for cut in (k for k, char in enumerate(key) if char == "_"):
                if key[:cut] in names and key[cut + 1 :] in names:
                    yield names[key[:cut]], names[key[cut + 1 :]], group
        elif key in names:
            for other, inner in group.items():
                if other in names and isinstance(inner, h5py.Group):
                    yield names[key], names[other], inner


def read_hloc(features: Path, matches: Path, names: Iterable[str], *, where: str) -> Tables:
    """Read features and matches of images, from hloc's own files or from ours.

    Args:
      names: of the images. Other images in the files are ignored.
      where: beginning of messages.

    Raises:
      UserError: a file is not HDF5, is damaged, or is inconsistent.
    """
    tables = Tables({}, {}, {}, {}, {})
    for path in (features, matches):
        if not path.is_file():
            raise UserError(f"{where} {path}: no such file")
    at = f"{where} {features}"
    try:
        with h5py.File(features, "r") as file:
            for name in names:
                group = file.get(name)
                if not isinstance(group, h5py.Group) or "keypoints" not in group:
                    continue
                own = f"{at}: {shown_name(name)}"
                values = dataset(group, "keypoints", own, MAX_KEYPOINTS)
                tables.keypoints[name] = checked_keypoints(values, own)
                if "image_size" in group:
                    size = dataset(group, "image_size", own, 2).astype(np.float64)
                    if size.shape != (2,) or not np.isfinite(size).all():
                        raise UserError(f"{own}: image_size must be two numbers")
                    tables.sizes[name] = (int(size[0]), int(size[1]))
        at = f"{where} {matches}"
        known: dict[str, str] = {}
        for name in tables.keypoints:
            short = name.replace("/", "-")
            if known.setdefault(short, name) != name:
                raise UserError(f"{at}: cannot tell {shown_name(name)} from {known[short]}")
        with h5py.File(matches, "r") as file:
            for name0, name1, group in pairs_in(file, known, "matches0"):
                pair, rows = _matches_of(group, (name0, name1), tables.keypoints, at)
                if len(rows):
                    tables.matches[pair] = rows
    except DAMAGED as error:
        raise UserError(f"{at}: not a readable file of hloc ({error})") from error
    return tables


def _matches_of(
    group: h5py.Group, names: tuple[str, str], keypoints: dict[str, np.ndarray], where: str
) -> tuple[Pair, np.ndarray]:
    own = f"{where}: {describe(names)}"
    second = dataset(group, "matches0", own, MAX_KEYPOINTS)
    count = len(keypoints[names[0]])
    if second.shape != (count,) or second.dtype.kind not in "iu":
        raise UserError(
            f"{own}: matches0 must be {count} integers, one for each keypoint of "
            f"{shown_name(names[0])}; got {second.dtype} {second.shape}"
        )
    if second.dtype == np.int16 and len(second) and second.min() < -1:
        raise UserError(
            f"{own}: matches0 is int16 and has overflowed (more than 32768 keypoints); "
            "hloc's matches of so many keypoints cannot be read"
        )
    first = np.flatnonzero(second.astype(np.int64) != -1)
    rows = np.stack([first, second[first].astype(np.int64)], axis=1)
    return checked_matches(rows, names, keypoints, own)
