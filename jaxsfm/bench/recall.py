"""How many of the pairs that show the same place are among the most similar photos.

`python -m jaxsfm.bench.recall PHOTOS... --truth TRUTH` describes the photos of one or more folders
as `reconstruct` does, and looks at the K most similar photos of each photo. TRUTH is the folder of
a COLMAP model, or of poses of 7-Scenes. By a model, a pair is *true* if its photos have 30 points
in common. By poses alone, a pair is true if each of its cameras sees half of what lies before the
other one at a distance of `--depth`.

Photos of other folders than that of the truth are strangers: their pairs with other photos are not
true.
"""

import argparse
import dataclasses
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.bench.figures import write_json
from jaxsfm.colmap.intrinsics import parse_intrinsics
from jaxsfm.colmap.poses import CameraPose, Poses, find_model, read_model, read_poses
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.io.weights import load_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.matching.retrieval import describe_photos, nearest_pairs
from jaxsfm.options import Retrieval

COMMON_POINTS = 30
"""Points that both photos of a true pair see in a model: COLMAP's least number of inliers of a
photo that it adds."""
OVERLAP = 0.5
"""The share of a photo that the other photo of a true pair sees, by poses alone."""
GRID = 9
"""Rays along either side of a photo, with which the overlap is measured."""
PARTNERS = 5
"""True partners with which a photo counts as well connected."""


class Found(NamedTuple):
    """What a number of similar photos finds."""

    pairs: int
    """That are tried."""
    true: int
    """Of them."""
    connected: int
    """Photos with at least PARTNERS true partners among the pairs, or with all that they have."""


def pairs_by_model(folder: Path, least: int = COMMON_POINTS) -> set[Pair]:
    """Pairs of photos that have at least so many points of a model in common.

    Raises:
      UserError: there is no model.
    """
    model = read_model(find_model(folder))
    common: dict[Pair, int] = {}
    for point in model.points3D.values():
        seen = {model.image(each.image_id).name for each in point.track.elements}
        for pair in itertools.combinations(sorted(seen), 2):
            common[pair] = common.get(pair, 0) + 1
    return {pair for pair, points in common.items() if points >= least}


def seen_share(
    one: CameraPose, other: CameraPose, camera: np.ndarray, size: tuple[int, int], depth: float
) -> float:
    """The share of what a camera sees at a distance that another one sees, from 0 to 1.

    Args:
      camera: float64 (3, 3), of both.
      size: width and height of both photos, in pixels; the centre of the first pixel is 0.5.
      depth: of all points along the optical axis, in units of the poses.
    """
    x, y = (np.linspace(0.5, side - 0.5, GRID) for side in size)
    pixels = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.ones(GRID * GRID)])
    points = one.rotation.T @ (depth * np.linalg.solve(camera, pixels)) + one.centre[:, None]
    at = camera @ other.rotation @ (points - other.centre[:, None])
    ahead = at[2] > 0
    x, y = at[:2] / np.where(ahead, at[2], 1.0)
    return float(np.mean(ahead & (x > 0) & (x < size[0]) & (y > 0) & (y < size[1])))


def pairs_by_poses(
    poses: Poses, camera: np.ndarray, size: tuple[int, int], depth: float
) -> set[Pair]:
    """Pairs of which each camera sees half of what the other one sees; see `seen_share`."""
    return {
        make_pair(a, b)
        for a, b in itertools.combinations(sorted(poses), 2)
        if min(
            seen_share(poses[a], poses[b], camera, size, depth),
            seen_share(poses[b], poses[a], camera, size, depth),
        )
        >= OVERLAP
    }


def found_pairs(tried: set[Pair], true: set[Pair]) -> Found:
    """How many of the true pairs are among those that are tried."""
    partners: dict[str, int] = {}
    hits: dict[str, int] = {}
    for pair in true:
        for name in pair:
            partners[name] = partners.get(name, 0) + 1
            hits[name] = hits.get(name, 0) + (pair in tried)
    connected = sum(hits[name] >= min(PARTNERS, all_) for name, all_ in partners.items())
    return Found(len(tried), len(tried & true), connected)


def _photos(folders: list[Path]) -> list[ImageFile]:
    """The photos of all folders; those of other folders than the first have its name before
    theirs."""
    photos: list[ImageFile] = []
    for k, folder in enumerate(folders):
        images, _ = open_images(folder)
        photos += [
            dataclasses.replace(i, name=f"{folder.name}/{i.name}") if k else i for i in images
        ]
    return photos


def _true_pairs(truth: Path, depth: float, photos: list[ImageFile]) -> set[Pair]:
    """The true pairs of photos, by a model or by poses.

    Raises:
      UserError: the folder has neither, or poses without K.txt.
    """
    names = {photo.name for photo in photos}
    if not any(truth.glob("*.pose.txt")):
        return {pair for pair in pairs_by_model(truth) if names.issuperset(pair)}
    given = parse_intrinsics(str(truth / "K.txt"))
    stored = {Path(photo.name).stem: photo for photo in photos}
    poses = {stored[n].name: pose for n, pose in read_poses(truth).items() if n in stored}
    if not poses:
        raise UserError(f"--truth {truth}: none of the photos has a pose")
    size = next(iter(stored.values())).size
    return pairs_by_poses(poses, given.camera(size).calibration_matrix(), size, depth)


def measure(
    photos: list[ImageFile], true: set[Pair], kinds: list[Retrieval], numbers: list[int]
) -> list[dict[str, Json]]:
    """A row for each way to compare photos and each number of similar photos."""
    weights, rows = load_weights(), []
    places = {name for pair in true for name in pair}
    for kind in kinds:
        described = describe_photos(weights, photos, kind=kind)
        for k in numbers:
            tried = set(nearest_pairs(described.vectors, k))
            found = found_pairs(tried, true)
            own = sum(places.issuperset(pair) for pair in tried)
            row: dict[str, Json] = {"retrieval": kind, "k": k, "pairs": found.pairs}
            row |= {"true": found.true, "of": len(true), "among_own": own}
            row |= {"connected": found.connected, "photos": len(places)}
            rows.append(row)
            print("\t".join(f"{name} {value}" for name, value in row.items()), flush=True)
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Measure some numbers of similar photos, and print a row for each."""
    parser = argparse.ArgumentParser(prog="jaxsfm.bench.recall", description=__doc__)
    parser.add_argument("photos", type=Path, nargs="+", help="folders; strangers come last")
    parser.add_argument("--truth", type=Path, required=True, help="a model, or 7-Scenes' poses")
    parser.add_argument("--depth", type=float, default=2.0, help="of what is seen, by poses alone")
    parser.add_argument("--every", type=int, default=1, help="each so many photos is used")
    parser.add_argument("--retrieval", default="vlad,gem", help="ways to compare photos")
    parser.add_argument("--k", default="5,10,20,50", help="numbers of similar photos")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    options = parser.parse_args(arguments)
    photos = _photos(options.photos)[:: options.every]
    true = _true_pairs(options.truth, options.depth, photos)
    numbers = [int(k) for k in options.k.split(",")]
    rows = measure(photos, true, options.retrieval.split(","), numbers)
    if options.json:
        write_json(options.json, {"rows": rows})


if __name__ == "__main__":
    main()
