"""How many of the pairs that show the same place are among the partners that retrieval chooses.

The photos are described as `reconstruct` does it. By a model, a pair is *true* if its photos have
30 points in common. By poses alone, a pair is true if each of its cameras sees half of what lies
before the other one at a given distance. Pairs of photos of other places are not true.
"""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.options import RecallOptions, whole_numbers
from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.poses import find_model, read_model, read_poses
from jaxsfm.colmap.view import View
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, exhaustive_pairs
from jaxsfm.io.pixels import Pixels
from jaxsfm.io.weights import load_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.matching.retrieval import describe_photos, partner_pairs
from jaxsfm.options import Retrieval

KINDS: list[Retrieval] = ["vlad", "gem"]
"""Ways to compare photos that need no other weights than those of the features."""
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
    largest: int
    """Photos in the largest group that true pairs join."""
    resistance: float
    """The mean of all pairs of photos in that group; see `mean_resistance`."""


def pairs_by_model(folder: Path, least: int = COMMON_POINTS) -> set[Pair]:
    """Pairs of photos that have at least so many points of a model in common.

    Raises:
      UserError: there is no model.
    """
    model = read_model(find_model(folder))
    common: Counter[Pair] = Counter()
    for point in model.points3D.values():
        seen = {model.image(each.image_id).name for each in point.track.elements}
        common.update(exhaustive_pairs(seen))
    return {pair for pair, points in common.items() if points >= least}


def seen_share(one: View, other: View, depth: float) -> float:
    """The share of what a view sees at a distance that another one sees, from 0 to 1.

    Args:
      depth: of all points along the optical axis, in units of the poses.
    """
    width, height = one.size
    x, y = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    at, _ = other.project(one.centre + depth * one.rays(np.c_[x.ravel(), y.ravel()]))
    with np.errstate(invalid="ignore"):  # NaN behind the camera
        return float(((at > -0.5) & (at < np.asarray(other.size) - 0.5)).all(1).mean())


def pairs_by_poses(views: Mapping[str, View], depth: float) -> set[Pair]:
    """Pairs of which each view sees half of what the other one sees; see `seen_share`."""

    def overlap(a: View, b: View) -> float:
        return min(seen_share(a, b, depth), seen_share(b, a, depth))

    return {(a, b) for a, b in exhaustive_pairs(views) if overlap(views[a], views[b]) >= OVERLAP}


def found_pairs(tried: set[Pair], true: set[Pair]) -> Found:
    """How many of the true pairs are among those that are tried."""
    partners = Counter(name for pair in true for name in pair)
    found = Counter(name for pair in true & tried for name in pair)
    connected = sum(found[name] >= min(PARTNERS, count) for name, count in partners.items())
    return Found(len(tried), len(tried & true), connected, *mean_resistance(tried & true))


def mean_resistance(pairs: set[Pair]) -> tuple[int, float]:
    """The size of the largest group of photos, and how far errors add up in it.

    Each pair measures how its photos lie to each other, with an error of variance 1. The mean
    resistance is the variance of the best estimate of how any two photos lie to each other. It is
    the electrical resistance between them if each pair is a resistor of 1 ohm. In a chain of n
    photos it is (n + 1) / 3; if all pairs are measured, 2 / n. Without pairs, the result is (0, 0).

    Source: Barooah and Hespanha 2007, "Estimation on graphs from relative measurements".
    """
    names = sorted({name for pair in pairs for name in pair})
    if not names:
        return 0, 0.0
    index = {name: i for i, name in enumerate(names)}
    joined = np.zeros((len(names), len(names)))
    for a, b in pairs:
        joined[index[a], index[b]] = joined[index[b], index[a]] = 1
    _, group = connected_components(joined, directed=False)
    own = group == np.bincount(group).argmax()
    joined = joined[np.ix_(own, own)]
    count = len(joined)
    values = np.linalg.eigvalsh(np.diag(joined.sum(1)) - joined)[1:]
    return count, float(2 / (count - 1) * (1 / values).sum())


def _photos(root: Path, strangers: Path | None) -> list[ImageFile]:
    """The photos of both folders. Strangers have the name of their folder before their own."""
    photos, _ = open_images(root)
    if strangers:
        others, _ = open_images(strangers)
        photos += [dataclasses.replace(i, name=f"{strangers.name}/{i.name}") for i in others]
    return photos


def _true_pairs(truth: Path, depth: float, photos: list[ImageFile]) -> set[Pair]:
    """The true pairs of photos, by a model or by poses.

    Raises:
      UserError: the folder has neither, or poses without K.txt.
    """
    names = {photo.name for photo in photos}
    if not any(truth.glob("*.pose.txt")):
        return {pair for pair in pairs_by_model(truth) if names.issuperset(pair)}
    camera = parse_intrinsics(str(truth / "K.txt"))
    stored = {Path(photo.name).stem: photo for photo in photos}
    views = {}
    for stem, pose in read_poses(truth).items():
        if (photo := stored.get(stem)) is not None:
            view = View.without_pose(
                photo.name, 0, camera.camera(photo.size), photo.size, Pixels((1.0, 1.0))
            )
            views[photo.name] = dataclasses.replace(
                view, rotation=pose.rotation, centre=pose.centre
            )
    if not views:
        raise UserError(f"--truth {truth}: none of the photos has a pose")
    return pairs_by_poses(views, depth)


def measure(
    photos: list[ImageFile],
    true: set[Pair],
    kinds: list[Retrieval],
    numbers: list[int],
    times: list[int],
) -> Iterator[dict[str, Json]]:
    """A row for each way to compare photos, number of partners, and number of candidates.

    Args:
      numbers: of partners.
      times: how many candidates there are for each partner.
    """
    weights = load_weights()
    places = {name for pair in true for name in pair}
    for kind in kinds:
        described = describe_photos(weights, photos, kind=kind)
        for k, many in itertools.product(numbers, times):
            tried = set(partner_pairs(described.vectors, k, candidates=many * k))
            found = found_pairs(tried, true)
            own = sum(places.issuperset(pair) for pair in tried)
            yield {
                "retrieval": kind,
                "partners": k,
                "candidates": many * k,
                "pairs": found.pairs,
                "true": found.true,
                "of": len(true),
                "among_own": own,
                "connected": found.connected,
                "photos": len(places),
                "largest": found.largest,
                "resistance": found.resistance,
            }


def bench_recall(options: RecallOptions) -> dict[str, Json]:
    """Measure some numbers of partners.

    Raises:
      UserError: a folder or an option cannot be used.
    """
    chosen = options.chosen_methods(KINDS)
    kinds: list[Retrieval] = [kind for kind in KINDS if kind in chosen]
    photos = _photos(options.root, options.strangers)[:: options.every]
    true = _true_pairs(options.truth, options.depth, photos)
    rows: list[dict[str, Json]] = []
    numbers = whole_numbers(options.partners, "--partners")
    times = whole_numbers(options.candidates, "--candidates")
    for row in measure(photos, true, kinds, numbers, times):
        rows.append(row)
        if options.json:
            write_json(options.json, {"rows": rows})
    return {"rows": rows}


def table_lines(figures: Mapping[str, Json]) -> list[str]:
    """A line for each way to compare photos, number of partners, and number of candidates."""
    rows: Any = figures["rows"]
    head = "retrieval partners  of      pairs    true of      among own"
    lines = [f"{head}  connected photos  largest  resistance"]
    return lines + [
        f"{row['retrieval']:<9} {row['partners']:>8}  {row['candidates']:<4} {row['pairs']:>7} "
        f"{row['true']:>7} {row['of']:<7} {row['among_own']:>9}  {row['connected']:>9} of "
        f"{row['photos']:<4} {row['largest']:>7} {row['resistance']:>11.3f}"
        for row in rows
    ]
