"""The view graph: which verified pairs to trust, because their rotations agree.

In scenes that repeat themselves (courtyards, rows of windows), pairs of images that show different
walls are verified. Each such pair looks sound by itself, but contradicts the other pairs. The pairs
are compared, the strongest first:

1. A pair's *weight* is its number of inliers, times the root of the share of the image that they
   cover. Its *edge weight* is the weight relative to the best pairs of its two images (geometric
   mean). The edge weight is less if the weight is small compared with those of other images' best
   pairs: an image of which all pairs are false has a best pair, too.
2. Pairs are joined strongest first, as in a maximum spanning tree. Where two groups of images meet,
   the pairs between them vote, with the squares of their edge weights, on the rotation between the
   groups; the largest group of agreeing votes decides. False pairs agree with each other where a
   scene repeats itself, so many weak ones say little more than one.
3. The rotations of all images are then averaged over the agreeing pairs (robustly), and a pair
   whose own rotation is further than `TRUST.rotation_deg` from them is dropped, unless it is
   strong: then its rotation may be poor (a plane, a guessed focal length), but its matches are
   sound.
4. A pair that alone joins two groups of photos agrees with the averaged rotations whatever its own
   rotation is. If it is not strong, nothing speaks for it, and it is dropped.

So a false pair is trusted only where no stronger pair contradicts it. The order of images and pairs
has no effect. On castle-P19 the rotations of false pairs are off by 75-180 deg, and their edge
weight is 0.01-0.09 there, before step 1 makes it less. Those of true pairs are off by less than 10
deg, with one exception in 90.
"""

import dataclasses
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from jaxsfm.colmap.poses import nearest_rotation
from jaxsfm.colmap.two_views import PairGeometry
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.sfm.limits import TRUST

MAX_VOTES = 500
"""At most so many pairs between two groups vote, the strongest ones: the cost is quadratic."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether a pair is trusted, and if not, why."""

    trusted: bool
    edge_weight: float
    """0 .. 1, see the module. Near 1: it is the best pair of both its images."""
    rotation_error_deg: float | None
    """The pair's own rotation against the averaged ones; None: it has none."""
    reason: str = ""
    """Why it is not trusted; empty for trusted pairs."""
    rejected: bool = False
    """The photos contradict each other where the pair joined them (`jaxsfm.sfm.check`)."""


def rotation_angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between rotations (..., 3, 3), degrees; accurate near zero, where arccos is not."""
    half_sine = np.linalg.norm(a - b, axis=(-2, -1)) / (2 * np.sqrt(2))
    return np.degrees(2 * np.arcsin(np.minimum(half_sine, 1.0)))


def edge_weights(geometries: Mapping[Pair, PairGeometry]) -> dict[Pair, float]:
    """The edge weight of every pair, 0 .. 1 (see the module)."""
    weight = {p: float(g.num_inliers * np.sqrt(g.spread)) for p, g in geometries.items()}
    return relative_weights(weight)


def relative_weights(weight: Mapping[Pair, float]) -> dict[Pair, float]:
    """The edge weight of every pair, 0 .. 1, by the weights of all pairs."""
    best: dict[str, float] = {}
    for pair, w in weight.items():
        for image in pair:
            best[image] = max(best.get(image, 0.0), w)
    known = [w for w in best.values() if w > 0]
    half = TRUST.weak * float(np.median(known)) if known else 0.0
    return {
        (a, b): float(w / np.sqrt(best[a] * best[b]) / (1 + (half / w) ** TRUST.steepness))
        if w > 0
        else 0.0
        for (a, b), w in weight.items()
    }


def trusted_pairs(
    geometries: Mapping[Pair, PairGeometry], *, strict: bool = False, first: Collection[Pair] = ()
) -> dict[Pair, Verdict]:
    """Decide for every pair, of image names in order, whether it is trusted.

    Args:
      strict: strong pairs may not have any rotation either. This is for photos of repeated
        structure, whose false pairs are as strong as true ones.
      first: pairs that are joined before all others, because something else than their edge weight
        speaks for them.
    """
    edge_weight = edge_weights(geometries)
    ranked = sorted(geometries, key=lambda p: (p not in first, -edge_weight[p], p))
    known = [p for p in ranked if geometries[p].rotation is not None and edge_weight[p] > 0]
    rotations = _average(_grow(known, geometries, edge_weight), known, geometries)
    verdicts = {}
    determined = set(known)
    for pair in sorted(geometries):
        error, reason = None, ""
        if pair not in determined:
            reason = "no relative pose"
        else:
            error = float(_error_deg(pair, geometries, rotations))
            if error > TRUST.rotation_deg and (strict or edge_weight[pair] < TRUST.strong):
                reason = (
                    f"its rotation is {error:.0f} deg from the one that stronger pairs give "
                    f"(its edge weight is {edge_weight[pair]:.3f} of 1)"
                )
        verdicts[pair] = Verdict(
            trusted=not reason,
            edge_weight=edge_weight[pair],
            rotation_error_deg=error,
            reason=reason,
        )
    for pair in bridges([pair for pair, verdict in verdicts.items() if verdict.trusted]):
        if edge_weight[pair] < TRUST.strong:
            why = (
                f"it alone joins two groups of photos, and it is weak (its edge weight is "
                f"{edge_weight[pair]:.3f} of 1)"
            )
            verdicts[pair] = dataclasses.replace(verdicts[pair], trusted=False, reason=why)
    return verdicts


def bridges(pairs: Collection[Pair]) -> list[Pair]:
    """The pairs without which a group of images would fall in two, sorted (Tarjan 1974)."""
    beside: dict[str, list[str]] = {}
    for a, b in pairs:
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    order, low, found = dict[str, int](), dict[str, int](), list[Pair]()
    for root in sorted(beside):
        if root in order:
            continue
        order[root] = low[root] = len(order)
        stack = [(root, "", iter(beside[root]))]
        while stack:
            image, parent, left = stack[-1]
            for other in left:
                if other not in order:
                    order[other] = low[other] = len(order)
                    stack.append((other, image, iter(beside[other])))
                    break
                if other != parent:
                    low[image] = min(low[image], order[other])
            else:
                stack.pop()
                if parent:
                    low[parent] = min(low[parent], low[image])
                    if low[image] > order[parent]:
                        found.append(make_pair(parent, image))
    return sorted(found)


Rotations = dict[str, np.ndarray]


def _rotation(pair: Pair, geometries: Mapping[Pair, PairGeometry]) -> np.ndarray:
    rotation = geometries[pair].rotation
    assert rotation is not None
    return rotation


def _error_deg(
    pair: Pair, geometries: Mapping[Pair, PairGeometry], rotations: Rotations
) -> np.ndarray:
    predicted = rotations[pair[1]] @ rotations[pair[0]].T
    return rotation_angle_deg(_rotation(pair, geometries), predicted)


def _grow(
    ranked: list[Pair],
    geometries: Mapping[Pair, PairGeometry],
    edge_weight: Mapping[Pair, float],
) -> Rotations:
    """Camera rotations (world to camera). Each connected group of images has a world of its own."""
    names = sorted({image for pair in ranked for image in pair})
    index = {name: k for k, name in enumerate(names)}
    joined = [(index[a], index[b]) for a, b in ranked]
    ends = np.asarray(joined).reshape(-1, 2)
    relative = np.asarray([_rotation(pair, geometries) for pair in ranked]).reshape(-1, 3, 3)
    votes = np.asarray([edge_weight[pair] for pair in ranked]) ** 2
    rotations = np.tile(np.eye(3), (len(names), 1, 1))
    group = list(range(len(names)))
    members = [[k] for k in group]
    # The pairs between any two groups that vote, the strongest first, are kept, not searched for
    # each time: the search took 49 of the 79 s that the view graph of 10 000 photos needed.
    between: list[dict[int, list[int]]] = [{} for _ in names]
    for rank, (i, j) in enumerate(joined):
        between[i].setdefault(j, []).append(rank)
        between[j][i] = between[i][j]
    for i, j in joined:
        a, b = group[i], group[j]
        if a == b:
            continue
        rows = np.asarray(between[a][b])
        swap = np.asarray([group[k] != a for k in ends[rows, 0]])
        in_a = np.where(swap, ends[rows, 1], ends[rows, 0])
        in_b = np.where(swap, ends[rows, 0], ends[rows, 1])
        turned = np.where(swap[:, None, None], relative[rows].transpose(0, 2, 1), relative[rows])
        # From the world of b to the world of a, as each pair determines it.
        moves = rotations[in_a].transpose(0, 2, 1) @ turned.transpose(0, 2, 1) @ rotations[in_b]
        close = rotation_angle_deg(moves[:, None], moves[None]) < TRUST.rotation_deg
        # Among equals the first one wins, which is the strongest.
        winner = int(np.argmax(close @ votes[rows]))
        move = mean_rotation(moves[close[winner]], votes[rows][close[winner]])
        if len(members[b]) > len(members[a]):
            a, b, move = b, a, move.T
        rotations[members[b]] = rotations[members[b]] @ move.T
        for k in members[b]:
            group[k] = a
        members[a] += members[b]
        _join(between, a, b)
    return dict(zip(names, rotations, strict=True))


def _join(between: list[dict[int, list[int]]], a: int, b: int) -> None:
    """Group b becomes part of group a: the pairs of b with others are those of a. Those that would
    not vote are forgotten."""
    del between[a][b], between[b][a]
    for other, ranks in between[b].items():
        del between[other][b]
        both = sorted(between[a].get(other, []) + ranks)[:MAX_VOTES]
        between[a][other] = between[other][a] = both
    between[b].clear()


def mean_rotation(rotations: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The chordal L2 mean of rotations (n, 3, 3): the rotation nearest to their weighted mean."""
    return nearest_rotation(np.einsum("n,nij->ij", weights, rotations))


def _average(
    rotations: Rotations, pairs: Iterable[Pair], geometries: Mapping[Pair, PairGeometry]
) -> Rotations:
    """Average rotations robustly.

    Every image in turn takes the mean of the rotations that its pairs imply, until nothing moves.
    The weights are inliers / (1 + (error / 2 deg)^2)^2.
    """
    around: dict[str, list[tuple[str, np.ndarray, int]]] = {}
    for pair in sorted(pairs):
        relative, count = _rotation(pair, geometries), geometries[pair].num_inliers
        around.setdefault(pair[1], []).append((pair[0], relative, count))
        around.setdefault(pair[0], []).append((pair[1], relative.T, count))
    stacked = {
        image: (
            [other for other, _, _ in rows],
            *map(np.asarray, list(zip(*rows, strict=True))[1:]),
        )
        for image, rows in around.items()
    }
    rotations = dict(rotations)
    for _ in range(50):
        largest = 0.0
        for image in sorted(stacked):
            others, relative, counts = stacked[image]
            implied = relative @ np.asarray([rotations[other] for other in others])
            error = rotation_angle_deg(implied, rotations[image])
            new = mean_rotation(implied, counts / (1.0 + (error / 2.0) ** 2) ** 2)
            largest = max(largest, float(rotation_angle_deg(new, rotations[image])))
            rotations[image] = new
        if largest < 1e-3:
            break
    return rotations
