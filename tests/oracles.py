"""Slow, obvious twins of the core, in numpy and OpenCV; written once, used by all tests."""

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxsfm.core.vgg import BLOCKS


def convolution(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """3 x 3 cross-correlation with zero padding, float64, one tap at a time."""
    h, w, _ = x.shape
    padded = np.pad(x.astype(np.float64), ((1, 1), (1, 1), (0, 0)))
    out = np.zeros((h, w, kernel.shape[3])) + bias
    for i in range(3):
        for j in range(3):
            out += padded[i : i + h, j : j + w] @ kernel[i, j].astype(np.float64)
    return out


def max_pool(x: np.ndarray) -> np.ndarray:
    """2 x 2, stride 2, flooring."""
    h, w = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
    x = x[:h, :w]
    return np.maximum.reduce([x[::2, ::2], x[1::2, ::2], x[::2, 1::2], x[1::2, 1::2]])


def vgg(params: dict, image: np.ndarray) -> list[np.ndarray]:
    """conv1_2 before the rectifier, pool1 .. pool5."""
    maps, x = [], image
    for block, widths in enumerate(BLOCKS, start=1):
        for conv in range(1, len(widths) + 1):
            layer = params["params"][f"conv{block}_{conv}"]
            x = convolution(x, np.asarray(layer["kernel"]), np.asarray(layer["bias"]))
            if (block, conv) == (1, 2):
                maps.append(x)
            x = np.maximum(x, 0)
        x = max_pool(x)
        maps.append(x)
    return maps


def windows(x: np.ndarray, side: int, stride: int, before: int, count: tuple[int, int]):
    """(row, column) -> the side x side window that starts at stride * (row, column) - before; zero
    outside x."""
    after = side + stride * max(count)
    padded = np.pad(x.astype(np.float64), ((before, after), (before, after), (0, 0)))
    for r in range(count[0]):
        for c in range(count[1]):
            yield (r, c), padded[stride * r :, stride * c :][:side, :side]


def alexnet(params: dict, image: np.ndarray) -> dict[str, np.ndarray]:
    """The maps of an image: conv1 at every pixel, rectified and pooled; conv2; conv5."""

    def convolve(x, name, stride, before, count):
        kernel, bias = (
            np.asarray(params["params"][name][k], np.float64) for k in ("kernel", "bias")
        )
        out = np.zeros((*count, len(bias)))
        for at, window in windows(x, kernel.shape[0], stride, before, count):
            out[at] = np.tensordot(window, kernel, 3) + bias
        return out

    def largest(x, side, before, count):
        out = np.zeros((*count, x.shape[2]))
        for at, window in windows(x, side, 2, before, count):
            out[at] = window.max((0, 1))
        return out

    h, w = image.shape[:2]
    maps = {"conv1": convolve(image, "conv1", 1, 5, (h, w))}
    for name, side in (("two", 2), ("four", 4)):
        last = maps["conv1"] if side == 2 else maps["two"]
        maps[name] = largest(np.maximum(last, 0), 2, 0, (h // side, w // side))
    x = np.maximum(convolve(image, "conv1", 4, 5, (h // 4, w // 4)), 0)
    x = largest(x, 3, 0, (h // 8, w // 8))
    maps["conv2"] = x = np.maximum(convolve(x, "conv2", 1, 2, x.shape[:2]), 0)
    x = largest(x, 3, 1, (h // 16, w // 16))
    for name in ("conv3", "conv4", "conv5"):
        x = np.maximum(convolve(x, name, 1, 1, x.shape[:2]), 0)
    return maps | {"conv5": x}


def children_of(shape, row: int, col: int, k: int) -> list[tuple[int, int]]:
    """The k x k cells around the 2 x 2 below a cell, in row order, as far as there are any."""
    first = -(k - 2) // 2
    block = [(2 * row + first + i, 2 * col + first + j) for i in range(k) for j in range(k)]
    return [(r, c) for r, c in block if 0 <= r < shape[0] and 0 <= c < shape[1]]


def relocalize(maps: list[np.ndarray], row: int, col: int, k: int = 2) -> tuple[int, int]:
    """(x, y) of one cell's walk down feature maps, coarse to fine."""
    for level in maps:
        children = children_of(level.shape, row, col, k)
        norms = [float((level[r, c].astype(np.float64) ** 2).sum()) for r, c in children]
        row, col = children[int(np.argmax(norms))]
    return col, row


def random_walk(scores, row: int, col: int, temperature: float, k: int, offset: float) -> dict:
    """(x, y) -> probability of where one cell's random walk ends, path by path."""
    ends = {(row, col): 1.0}
    for level in scores:
        below: dict[tuple[int, int], float] = {}
        for (r, c), p in ends.items():
            children = children_of(level.shape, r, c, k)
            share = np.asarray([(float(level[i]) + offset) ** (1 / temperature) for i in children])
            for child, each in zip(children, share / share.sum(), strict=True):
                below[child] = below.get(child, 0.0) + p * each
        ends = below
    return {(c, r): p for (r, c), p in ends.items()}


def mutual_nn(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mutual nearest neighbours by full distance matrix, and by how much each was decided."""
    s = a.astype(np.float64) @ b.T.astype(np.float64)
    s[~a.any(1)] = -np.inf
    s[:, ~b.any(1)] = -np.inf
    return _mutual(s)


def consensus_nn(a, b, grid0, grid1, weights) -> tuple[np.ndarray, np.ndarray]:
    """Mutual best cells under the sum of similarities over equal shifts, cell by cell."""
    radius = len(weights) // 2
    grid0, grid1 = ([int(n) for n in grid] for grid in (grid0, grid1))
    products = np.asarray(a, np.float64) @ np.asarray(b, np.float64).T
    s = np.full((len(a), len(b)), -np.inf)
    for i in np.flatnonzero(a.any(1)).tolist():
        for j in np.flatnonzero(b.any(1)).tolist():
            total = 0.0
            for dr in range(-radius, radius + 1):
                for dc in range(-radius, radius + 1):
                    at = []
                    for cell, (rows, columns) in ((i, grid0), (j, grid1)):
                        r, c = cell // columns + dr, cell % columns + dc
                        if 0 <= r < rows and 0 <= c < columns:
                            at.append(r * columns + c)
                    if len(at) == 2:
                        w = weights[dr + radius] * weights[dc + radius]
                        total += w * products[at[0], at[1]]
            s[i, j] = total
    return _mutual(s)


def _mutual(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    match = np.full(len(s), -1)
    margin = np.full(len(s), np.inf)
    for i in range(len(s)):
        j = int(np.argmax(s[i]))
        if not np.isfinite(s[i, j]):
            continue
        back = int(np.argmax(s[:, j]))
        if back == i:
            match[i] = j
        margin[i] = min(_gap(s[i]), _gap(s[:, j]))
    return match, margin


def _gap(values: np.ndarray) -> float:
    top = np.sort(values)[::-1]
    return float(top[0] - top[1]) if len(top) > 1 and np.isfinite(top[1]) else np.inf


def coarse_to_fine(coarse, fine0, fine1, grid0, grid1, fgrid0, fgrid1) -> set[tuple[int, int]]:
    """All fine pairs, window by window, with Python loops."""

    def window(cell, grid, fgrid):
        r, c = divmod(int(cell), int(grid[1]))
        rows = range(max(r - 1, 0) * 2, (min(r + 1, grid[0] - 1) + 1) * 2)
        cols = range(max(c - 1, 0) * 2, (min(c + 1, grid[1] - 1) + 1) * 2)
        return [i * int(fgrid[1]) + j for i in rows for j in cols]

    pairs = set()
    for cell0, cell1 in enumerate(coarse):
        if cell1 >= 0:
            w0, w1 = window(cell0, grid0, fgrid0), window(cell1, grid1, fgrid1)
            match, _ = mutual_nn(fine0[w0], fine1[w1])
            pairs |= {(w0[i], w1[j]) for i, j in enumerate(match) if j >= 0}
    return pairs


def homography(xy0: np.ndarray, xy1: np.ndarray) -> np.ndarray:
    """OpenCV's four-point solution or least squares, float64."""
    if len(xy0) == 4:
        return cv2.getPerspectiveTransform(xy0.astype(np.float32), xy1.astype(np.float32))
    return cv2.findHomography(xy0, xy1, 0)[0]


def transfer(h: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """h applied to points, float64."""
    p = np.concatenate([xy, np.ones((len(xy), 1))], axis=1).astype(np.float64) @ h.T
    return p[:, :2] / p[:, 2:]


def join_octaves(levels: list[np.ndarray], grid: np.ndarray, weight: float) -> np.ndarray:
    """Bilinear values of each octave at the first one's cells, weighted, side by side, unit."""

    def normal(x):
        return x / np.linalg.norm(x) if x.any() else x

    result = np.zeros((len(levels[0]), sum(x.shape[1] for x in levels)))
    for row in range(grid[0]):
        for col in range(grid[1]):
            cell = row * grid[1] + col
            if not levels[0][cell].any():
                continue
            parts = [levels[0][cell].astype(np.float64)]
            for k, x in enumerate(levels[1:], start=1):
                rows, cols = grid[0] >> k, grid[1] >> k
                total = np.zeros(x.shape[1])
                y, z = (row + 0.5) / 2**k - 0.5, (col + 0.5) / 2**k - 0.5
                for r in range(-1, rows + 1):
                    for c in range(-1, cols + 1):
                        w = max(0.0, 1 - abs(y - r)) * max(0.0, 1 - abs(z - c))
                        if w and rows and cols:
                            at = min(max(r, 0), rows - 1) * cols + min(max(c, 0), cols - 1)
                            total += w * x[at]
                parts.append(weight ** (k / 2) * normal(total))
            result[cell] = normal(np.concatenate(parts)) if len(parts) > 1 else parts[0]
    return result


# -- whole images ----------------------------------------------------------------------------------


def length_one(x: np.ndarray) -> np.ndarray:
    """x over its Euclidean length; zero stays zero."""
    length = np.sqrt((x * x).sum())
    return x / length if length > 0 else x


def gem(x: np.ndarray, power: float) -> np.ndarray:
    """Generalised mean, channel by channel."""
    rows = [row.astype(np.float64) for row in x if row.any()]
    means = [np.mean([max(v, 0) ** power for v in channel]) for channel in zip(*rows, strict=True)]
    return length_one(np.asarray(means) ** (1 / power))


def vlad(x: np.ndarray, mean, whitening, centres) -> np.ndarray:
    """One descriptor after the other."""
    sums = np.zeros(centres.shape)
    for row in x.astype(np.float64):
        if row.any():
            flat = length_one((row - mean) @ whitening)
            k = np.argmin([((flat - c) ** 2).sum() for c in centres])
            sums[k] += flat - centres[k]
    return length_one(np.concatenate([length_one(each) for each in sums]))


def netvlad(x: np.ndarray, assignment, centres, whitening, bias) -> np.ndarray:
    """weights_conversion/README.md, equation by equation; whitening's row 64 d + k is V[d, k]."""
    channels, words = centres.shape
    v = np.zeros((channels, words))
    for row in x.astype(np.float64):
        if row.any():
            row = length_one(row)
            weights = np.exp(row @ assignment)
            weights /= weights.sum()
            for k in range(words):
                v[:, k] += weights[k] * (row - centres[:, k])
    for k in range(words):
        v[:, k] = length_one(v[:, k])
    v = length_one(v)
    flat = np.asarray([v[i // words, i % words] for i in range(channels * words)])
    return length_one(flat @ whitening + bias)


def lloyd(x: np.ndarray, centres: np.ndarray, iterations: int) -> np.ndarray:
    """k-means; empty centres stay."""
    x, centres = x.astype(np.float64), centres.astype(np.float64)
    for _ in range(iterations):
        nearest = [np.argmin(((row - centres) ** 2).sum(1)) for row in x]
        for k in range(len(centres)):
            own = [row for row, n in zip(x, nearest, strict=True) if n == k]
            if own:
                centres[k] = np.mean(own, axis=0)
    return centres


def partners(x: np.ndarray, k: int, candidates: int, tie: float) -> np.ndarray:
    """The best other rows by their product, in steps of `tie`, then the lower index. Of these, one
    comes last if it is nearer to one before it that does not."""

    def product(i: int, j: int) -> int:
        return round(float(x[i].astype(np.float64) @ x[j]) / tie)

    rows = []
    for i in range(len(x)):
        others = sorted((-product(i, j), j) for j in range(len(x)) if j != i)[:candidates]
        differing: list[int] = []
        for _, j in others:
            if all(product(j, taken) <= product(i, j) for taken in differing):
                differing.append(j)
        rows.append((differing + [j for _, j in others if j not in differing])[:k])
    return np.asarray(rows)


# -- what verification keeps -----------------------------------------------------------------------


def one_to_one(cells: np.ndarray, keep: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Every cell of image 0 keeps its best entry, then every cell of image 1 of those; the first
    of equals."""
    keep = keep.copy()
    for side in (0, 1):
        best: dict[int, int] = {}
        for i in np.flatnonzero(keep).tolist():
            cell = int(cells[i, side])
            if cell not in best or score[i] > score[best[cell]]:
                best[cell] = i
        keep = np.isin(np.arange(len(keep)), list(best.values()))
    return keep


def inliers(h, xy0, xy1, threshold: float) -> np.ndarray:
    """Points that h moves to less than `threshold` from their partners."""
    return np.linalg.norm(transfer(np.asarray(h, np.float64), xy0) - xy1, axis=1) < threshold


def bundle_adjustment(cameras, points: np.ndarray, xy: np.ndarray, weight: np.ndarray) -> tuple:
    """Rotations, translations and points of the least weighted sum of squared distances, found by
    scipy from near the minimum, all poses free; afterwards in the frame of the first camera, with
    the second at distance 1. The fourth result is the weighted root mean square distance."""
    c = len(cameras.rotations)
    turns = Rotation.from_matrix(cameras.rotations).as_rotvec()

    def parts(x):
        return x[: 3 * c].reshape(c, 3), x[3 * c : 6 * c].reshape(c, 3), x[6 * c :].reshape(-1, 3)

    def residuals(x):
        turns, shifts, points = parts(x)
        out = []
        for k in range(c):
            seen = Rotation.from_rotvec(turns[k]).apply(points) + shifts[k]
            image = seen @ cameras.intrinsics[k].T
            distance = image[:, :2] / image[:, 2:] - xy[k]
            out.append(np.sqrt(weight[k])[:, None] * distance)
        return np.concatenate(out).ravel()

    begin = np.concatenate([x.ravel() for x in (turns, cameras.translations, points)])
    tight = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}
    found = least_squares(residuals, begin, jac="3-point", **tight)
    turns, shifts, points = parts(found.x)
    rotations = Rotation.from_rotvec(turns).as_matrix()
    points = points @ rotations[0].T + shifts[0]
    rotations = rotations @ rotations[0].T
    shifts = shifts - rotations @ shifts[0]
    length = np.linalg.norm(shifts[1])
    error = np.sqrt(np.sum(found.fun**2) / np.sum(weight))
    return rotations, shifts / length, points / length, error


# -- view graph ----------------------------------------------------------------------------------


def grown_rotations(pairs: dict, most_votes: int, tolerance_deg: float) -> list[dict]:
    """Rotations of images (world to camera) in groups that pairs join, the strongest pair first.

    Where two groups meet, every pair between them is looked up anew, and votes on the rotation from
    the world of the one to that of the other.

    Args:
      pairs: by two names, the rotation from the first camera to the second (scipy's), and the
        vote. The strongest pair comes first.
    """
    groups = [{name: Rotation.identity()} for name in sorted({each for p in pairs for each in p})]
    for pair in pairs:
        one, other = (next(g for g in groups if name in g) for name in pair)
        if one is other:
            continue
        moves = []
        for (a, b), (relative, vote) in pairs.items():
            if a in one and b in other:
                moves.append((one[a].inv() * relative.inv() * other[b], vote))
            elif a in other and b in one:
                moves.append((one[b].inv() * relative * other[a], vote))
        moves = moves[:most_votes]
        agreeing = [
            [(r, w) for r, w in moves if np.degrees((move.inv() * r).magnitude()) < tolerance_deg]
            for move, _ in moves
        ]
        won = max(agreeing, key=lambda each: sum(w for _, w in each))
        rotations, weights = zip(*won, strict=True)
        move = Rotation.concatenate(rotations).mean(weights)
        groups = [g for g in groups if g is not one and g is not other]
        groups.append({**one, **{name: r * move.inv() for name, r in other.items()}})
    return groups


# -- checks of models ------------------------------------------------------------------------------


def grouped(tested, contradicted, undecided, most: float, least: int) -> tuple[list[set], dict]:
    """Groups of views, the largest first, and what contradicts what: set by set, sum by sum.

    Two groups agree if, in one of the two directions, at most the share `most` of the points of one
    is contradicted by the other, and if both directions have `least` points. Every undecided point
    makes up for one and a half contradictions. The pair of groups is joined whose lesser share,
    with one contradiction more, is lowest.
    """

    def directions(one: frozenset, other: frozenset) -> list[tuple[int, float]]:
        """(points, contradictions) of both directions, the better one first; none if too few."""
        sums = []
        for group, against in ((one, other), (other, one)):
            n = sum(int(tested[i, j]) for i in group for j in against)
            no = sum(int(contradicted[i, j]) for i in group for j in against)
            perhaps = sum(int(undecided[i, j]) for i in group for j in against)
            sums.append((n, max(no - 1.5 * perhaps, 0.0)))
        if min(n for n, _ in sums) < least:
            return []
        return sorted(sums, key=lambda each: each[1] / each[0])

    groups = [frozenset([k]) for k in range(len(tested))]
    while True:
        agreeing = []
        for i, one in enumerate(groups):
            for other in groups[i + 1 :]:
                sums = directions(one, other)
                if sums and sums[0][1] / sums[0][0] <= most:
                    agreeing.append((min((c + 1) / n for n, c in sums), one, other))
        if not agreeing:
            break
        _, one, other = min(agreeing, key=lambda each: each[0])
        groups = [group for group in groups if group not in (one, other)] + [one | other]
    against = {
        frozenset((one, other)): tuple(map(int, directions(one, other)[0]))
        for i, one in enumerate(groups)
        for other in groups[i + 1 :]
        if directions(one, other)
    }
    return [set(g) for g in sorted(groups, key=lambda g: (-len(g), sorted(g)))], against


def mapper_matches(keypoints: dict, matches: dict, grid: int, per_pair: int) -> dict[tuple, set]:
    """The matches (pairs of indices) that the mapper is given, by loops.

    Args:
      keypoints: by image, its keypoints (n, 2) and its size.
      matches: by pair of images, the indices (m, 2).
    """
    partners: dict = {}
    for (a, b), rows in matches.items():
        for i, j in rows.tolist():
            partners.setdefault((a, i), set()).add((b, j))
            partners.setdefault((b, j), set()).add((a, i))
    first, count = {}, 0
    for name in sorted(keypoints):
        first[name], count = count, count + len(keypoints[name][0])

    def cell(name, index):
        (x, y), (width, height) = keypoints[name][0][index], keypoints[name][1]
        column, row = int((x + 0.5) / width * grid), int((y + 0.5) / height * grid)
        return min(max(column, 0), grid - 1), min(max(row, 0), grid - 1)

    def place(end):
        return (first[end[0]] + end[1]) * 2654435761 % 2**32

    def worth(ends):
        one, other = (partners[end] for end in ends)
        return -len(one & other), -len(one) - len(other), *map(place, ends)

    chosen = set()
    for (a, b), rows in matches.items():
        ends = sorted((((a, i), (b, j)) for i, j in rows.tolist()), key=worth)
        turn = {}
        for match in ends:
            before = ends[: ends.index(match)]
            turn[match] = max(
                sum(cell(*other[side]) == cell(*match[side]) for other in before) for side in (0, 1)
            )
        for match in sorted(ends, key=lambda match: (turn[match], worth(match)))[:per_pair]:
            chosen |= {*match}
    return {
        (a, b): {(i, j) for i, j in rows.tolist() if {(a, i), (b, j)} <= chosen}
        for (a, b), rows in matches.items()
    }
