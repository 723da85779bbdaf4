"""Laws of the naive coarse-to-fine matching."""

import itertools

import jax
import numpy as np
import oracles
import pytest
from compiled import compiled
from strategies import rng_of

from jaxsfm.core import naive
from jaxsfm.core.pair_shape import PairShape
from jaxsfm.core.types import JoinedFeatures, Status, Thresholds

descend, match_naively = compiled(naive.descend), compiled(naive.match_naively, "shape")


def maps_of(rng, rows, columns, levels):
    """`levels` maps below one of rows x columns cells."""
    return [
        rng.normal(size=(rows << k, columns << k, 3 + k)).astype(np.float32)
        for k in range(1, levels + 1)
    ]


def slow_descent(maps0, maps1, cell0, cell1):
    """One match, level by level, by trying the sixteen pairs of children."""
    for level0, level1 in zip(maps0, maps1, strict=True):
        best = -np.inf
        tried = itertools.product(*(itertools.product((0, 1), repeat=2) for _ in range(2)))
        for step0, step1 in tried:
            child0 = tuple(2 * np.asarray(cell0) + step0)
            child1 = tuple(2 * np.asarray(cell1) + step1)
            a, b = oracles.length_one(level0[child0]), oracles.length_one(level1[child1])
            if a @ b > best:
                best, chosen = a @ b, (child0, child1)
        cell0, cell1 = chosen
    return cell0, cell1


@pytest.mark.parametrize("seed", range(3))
def test_a_match_goes_to_the_most_similar_children(seed):
    rng = rng_of(seed)
    maps0, maps1 = maps_of(rng, 4, 5, 3), maps_of(rng, 3, 6, 3)
    cells0 = rng.integers([4, 5], size=(30, 2))
    cells1 = rng.integers([3, 6], size=(30, 2))
    ours = descend(maps0, maps1, np.int32(cells0), np.int32(cells1))
    for k in range(30):
        expected = slow_descent(maps0, maps1, cells0[k], cells1[k])
        np.testing.assert_array_equal([ours[0][k], ours[1][k]], expected)


def test_a_shifted_image_is_matched_pixel_by_pixel():
    """Image 1 is image 0 moved by two coarse cells: each match is off by just that shift."""
    rng, rows, columns, shift = rng_of(7), 12, 16, 2
    wide = [rng.normal(size=(rows << k, (columns + shift) << k, 8)) for k in range(5)]

    def side(first):
        maps = [np.float32(m[:, first << k :][:, : columns << k]) for k, m in enumerate(wide)]
        flat = [np.float32([oracles.length_one(x) for x in m.reshape(-1, 8)]) for m in maps[:2]]
        grids = [np.int32([rows << k, columns << k]) for k in range(2)]
        keypoints = np.zeros((len(flat[1]), 2), np.float32)
        features = JoinedFeatures(flat[0], flat[1], keypoints, grids[0], grids[1])
        return features, maps[2:]

    (f0, maps0), (f1, maps1) = side(0), side(shift)
    limits = Thresholds(np.float32(1.0), np.int32(26), np.float32(0.999))
    shape = PairShape(max_planes=1)
    found = match_naively(jax.random.key(0), (f0, f1), (maps0, maps1), limits, shape=shape)
    assert int(found.status) == Status.VERIFIED
    kept = found.plane >= 0
    xy0, xy1 = (
        np.stack(np.divmod(found.cells[kept, k], columns << 4)[::-1], axis=1) for k in (0, 1)
    )
    assert kept.sum() > 200
    np.testing.assert_array_equal(xy0 - xy1, np.tile([shift << 4, 0], (kept.sum(), 1)))
