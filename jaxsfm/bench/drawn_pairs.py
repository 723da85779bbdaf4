"""Pairs of photos with known poses, drawn from sets of them; the second photo is altered."""

import itertools
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.alterations import Alteration, Altered
from jaxsfm.bench.matches import Matches
from jaxsfm.bench.strecha_sets import StrechaSet, place_of
from jaxsfm.bench.wxbs import symmetric_epipolar_error
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.errors import UserError
from jaxsfm.io.photo_folder import find_images
from jaxsfm.sfm.evaluation import pair_names
from jaxsfm.sfm.two_photos.common_view import mapped

NEAR_PX = 10.0
"""A match this near to its epipolar lines may be right, pixels of the altered photo. Of random
matches a few per cent are."""
STRANGERS = 1 / 3
"""The share of the draws whose photos are of two sets; it is less if sets show one place."""


class PosedPhoto(NamedTuple):
    """A photo of a set."""

    scene: str
    """The name of the set."""
    path: Path
    camera: np.ndarray
    """float64 (3, 3), the camera matrix; the centre of the top-left pixel is (0, 0)."""
    pose: CameraPose


class DrawnPair(NamedTuple):
    """Two photos, and how the second one is altered."""

    first: PosedPhoto
    second: PosedPhoto
    alteration: Alteration

    @property
    def name(self) -> str:
        """The photos, and what is done to the second one."""
        a, b = (f"{each.scene}/{each.path.stem}" for each in (self.first, self.second))
        return f"{a} {b} {self.alteration}"

    @property
    def one_place(self) -> bool:
        """Whether both photos are of one set."""
        return self.first.scene == self.second.scene

    def near_share(self, altered: Altered, found: Matches) -> float:
        """The share of matches with the altered photo that are within `NEAR_PX` of their epipolar
        lines. It is 0 for photos of different places, and without matches."""
        if not self.one_place or not len(found.xy0):
            return 0.0
        f = true_fundamental_matrix(self.first, self.second)
        error = symmetric_epipolar_error(f, found.xy0, mapped(altered.to_original, found.xy1))
        return float((error <= NEAR_PX * altered.pixel).mean())


def true_fundamental_matrix(first: PosedPhoto, second: PosedPhoto) -> np.ndarray:
    """F with x1' F x0 = 0 for pixels of two photos, float64 (3, 3).

    Source: Hartley and Zisserman, 2nd edition, equation 9.2.
    """
    rotation = second.pose.rotation @ first.pose.rotation.T
    x, y, z = second.pose.rotation @ (first.pose.centre - second.pose.centre)
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(second.camera).T @ cross @ rotation @ np.linalg.inv(first.camera)


def posed_photos(given: StrechaSet) -> list[PosedPhoto]:
    """The photos of a set that have a pose.

    Raises:
      UserError: there are fewer than two.
    """
    fx, fy, cx, cy = (float(v) for v in given.camera.split(":")[1].split(","))
    # COLMAP's pixels begin at the corner of the photo.
    camera = np.asarray([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    folder = given.folder / "images"
    known = sorted(pair_names(find_images(folder), given.truth).items())
    if len(known) < 2:
        raise UserError(f"--root: {folder} has fewer than two photos with a pose")
    return [
        PosedPhoto(given.folder.name, folder / name, camera, given.truth[other])
        for name, other in known
    ]


def drawn_pairs(sets: Sequence[Sequence[PosedPhoto]], number: int) -> Iterator[DrawnPair]:
    """The first `number` pairs of an endless list that depends on the names of the sets alone.

    Photos of two sets are of two places: the poses of two sets of one place are not comparable.
    """
    endless = filter(None, (_drawn(sets, k) for k in itertools.count()))
    return itertools.islice(endless, number)


def _drawn(sets: Sequence[Sequence[PosedPhoto]], k: int) -> DrawnPair | None:
    """The k-th pair; None if its photos are of two sets of one place."""
    names = [photos[0].scene for photos in sets]
    rng = np.random.default_rng([k, *(zlib.crc32(name.encode()) for name in names)])
    own = int(rng.integers(len(sets)))
    strange = len(sets) > 1 and rng.random() < STRANGERS
    other = (own + int(rng.integers(1, len(sets)))) % len(sets) if strange else own
    first = int(rng.integers(len(sets[own])))
    if strange:
        second = int(rng.integers(len(sets[other])))
    else:
        second = (first + int(rng.integers(1, len(sets[own])))) % len(sets[own])
    if strange and place_of(names[own]) == place_of(names[other]):
        return None
    return DrawnPair(sets[own][first], sets[other][second], drawn_alteration(rng))


def drawn_alteration(rng: np.random.Generator) -> Alteration:
    """A random alteration. Some leave a pair easy, and some leave nothing to match."""
    side = float(rng.uniform(0.3, 1.0)) if rng.random() < 0.5 else 1.0
    x, y = rng.uniform(0, 1 - side, 2)
    return Alteration(
        corner=(float(x), float(y)),
        side=side,
        scale=float(2 ** rng.uniform(-2.0, 0.0)),
        severity=float(rng.uniform(2.0, 4.3)) if rng.random() < 0.5 else 0.0,
        quarters=int(rng.integers(1, 4)) if rng.random() < 0.25 else 0,
    )
