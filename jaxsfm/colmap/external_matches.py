"""Matches of the same photos that another tool made, mapped together with ours in one model."""

import dataclasses
import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.formats.database import read_database
from jaxsfm.colmap.formats.tables import Tables
from jaxsfm.colmap.intrinsics import Intrinsics, KnownCameras, camera_of
from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json, sha256_of
from jaxsfm.io.images import ImageFile, shown_name
from jaxsfm.io.pairs import LazyMatches, Pair, PairCounts, PairResult, united

logger = logging.getLogger("jaxsfm")

BORDER_PX = 1.0
"""Keypoints this far outside an image are moved to its border. The rounding of float16, and
detectors that count pixels from their corners, put them there."""
FOCAL_RATIO = 1.1
"""Focal lengths may differ by this factor, because EXIF knows them to a few percent."""


class ExternalMatches(NamedTuple):
    """Matches that another tool made."""

    keypoints: dict[str, np.ndarray]
    """By image name float32 (n, 2), original pixels, centre of the top-left pixel (0, 0)."""
    matches: dict[Pair, np.ndarray]
    """int32 (m, 2): indices of keypoints, one to one."""
    about: dict[str, Json] | None
    """Where they came from, as plain JSON (`jaxsfm.report.run_inputs.UsedExternalMatches`)."""

    def result(self, pair: Pair) -> PairResult:
        """The matches of a pair, in the form of ours. They are on no plane."""
        rows = self.matches[pair]
        return PairResult(
            pair=pair,
            cells=rows,
            keypoints0=self.keypoints[pair[0]][rows[:, 0]],
            keypoints1=self.keypoints[pair[1]][rows[:, 1]],
            plane=np.full(len(rows), -1, np.int32),
            homographies=np.zeros((0, 3, 3)),
            num_tentative=len(rows),
            num_dropped=0,
            status=Status.VERIFIED,
        )

    def counts(self, ours: Mapping[Pair, PairCounts]) -> dict[Pair, PairCounts]:
        """The counts of every pair: ours where it has inliers, otherwise the external ones."""
        theirs = {pair: self.result(pair).counts for pair in self.matches}
        return theirs | {p: c for p, c in ours.items() if c.num_inliers or p not in theirs}


NO_EXTERNAL_MATCHES = ExternalMatches({}, {}, None)


def read_external_matches(
    database: Path | None,
    hloc: tuple[Path, Path] | None,
    images: Collection[ImageFile],
    intrinsics: KnownCameras | None,
    *,
    dense: Path | None = None,
) -> ExternalMatches:
    """Read the matches of `--with-database`, `--with-hloc` or `--with-dense`, and check them
    against the photos.

    If the file holds two-view inliers, these are used; otherwise its matches. Cameras are not
    taken over.

    Raises:
      UserError: the files cannot be read, are inconsistent, or are of other photos, sizes or
        cameras.
    """
    if sum(each is not None for each in (database, hloc, dense)) > 1:
        raise UserError("--with-database, --with-hloc and --with-dense: give only one of them")
    if database is not None:
        where, files = f"--with-database {database}", [database]
        tables = read_database(database, where=where)
    elif hloc is not None:
        from jaxsfm.colmap.formats.hloc import read_hloc  # loads h5py

        where, files = "--with-hloc", list(hloc)
        tables = read_hloc(*hloc, [image.name for image in images], where=where)
    elif dense is not None:
        from jaxsfm.colmap.formats.dense_matches import read_dense_matches  # loads h5py

        where, files = f"--with-dense {dense}", [dense]
        tables = read_dense_matches(dense, {each.name: each.size for each in images}, where=where)
    else:
        return NO_EXTERNAL_MATCHES
    return _checked(tables, images, intrinsics, where, files)


def _checked(
    tables: Tables,
    images: Collection[ImageFile],
    intrinsics: KnownCameras | None,
    where: str,
    files: list[Path],
) -> ExternalMatches:
    known = {image.name: image for image in images}
    ignored = sorted(tables.keypoints.keys() - known.keys())
    keypoints = {}
    for name in sorted(tables.keypoints.keys() & known.keys()):
        size = known[name].size
        if tables.sizes.get(name, size) != size:
            raise UserError(
                f"{where}: {shown_name(name)} is {_by(tables.sizes[name])} pixels there, "
                f"but the photo {_by(size)}"
            )
        if intrinsics is not None and name in tables.focal_px:
            camera = camera_of(intrinsics, known[name])
            _check_focal(tables.focal_px[name], camera, where, name)
        inside = np.clip(
            tables.keypoints[name], -0.5, np.asarray(size, np.float32) - np.float32(0.5)
        )
        if (np.abs(inside - tables.keypoints[name]) > BORDER_PX).any():
            raise UserError(f"{where}: {shown_name(name)} has keypoints outside its {_by(size)}")
        keypoints[name] = inside
    if not keypoints:
        raise UserError(f"{where}: none of its images is among the photos")
    if ignored:
        logger.warning(
            "%s: %d images are not among the photos and are ignored, first %s",
            where,
            len(ignored),
            shown_name(ignored[0]),
        )
    matches = {
        pair: _one_to_one(rows)
        for pair, rows in sorted((tables.inliers or tables.matches).items())
        if pair[0] in keypoints and pair[1] in keypoints
    }
    about: dict[str, Json] = {
        "files": [str(path.absolute()) for path in files],
        "sha256": [sha256_of(path) for path in files],
        "verified": bool(tables.inliers),
        "images": len(keypoints),
        "ignored": ignored,
        "pairs": len(matches),
        "matches": sum(map(len, matches.values())),
    }
    return ExternalMatches(keypoints, matches, about)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _one_to_one(rows: np.ndarray) -> np.ndarray:
    """Keep only matches (m, 2) that are the first of both their keypoints, as tracks need it."""
    first0, first1 = (np.unique(column, return_index=True)[1] for column in rows.T)
    return rows[np.intersect1d(first0, first1)]


def _check_focal(focal: float, intrinsics: Intrinsics, where: str, name: str) -> None:
    ours = intrinsics.params[0]
    if not ours / FOCAL_RATIO < focal < ours * FOCAL_RATIO:
        raise UserError(
            f"{where}: {shown_name(name)} has a focal length of {focal:g} pixels there, "
            f"but --intrinsics say {ours:g}"
        )


class JoinedMatches(LazyMatches):
    """Our matches and external ones together. A pair is joined when it is asked for.

    In every image, external keypoints come first, and our cells are numbered on from there.

    Args:
      names: the images that are mapped.
    """

    def __init__(
        self,
        ours: Mapping[Pair, PairResult],
        external: ExternalMatches,
        names: Collection[str],
    ) -> None:
        self._ours, self._external = ours, external
        theirs = (pair for pair in external.matches if pair[0] in names and pair[1] in names)
        super().__init__(sorted({*ours, *theirs}))

    def _load(self, pair: Pair) -> PairResult:
        parts = []
        if pair in self._external.matches:
            parts.append(self._external.result(pair))
        if pair in self._ours:
            keypoints = self._external.keypoints
            first = np.asarray([len(keypoints.get(name, ())) for name in pair], np.int32)
            ours = self._ours[pair]
            parts.append(dataclasses.replace(ours, cells=ours.cells + first))
        return parts[0] if len(parts) == 1 else united(*parts)
