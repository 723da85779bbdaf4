"""Time of a batch of pairs relative to the same pairs one after the other."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.bench.speed.timing import Metric, median, ratio, seconds
from jaxsfm.config import PRESETS
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.types import Thresholds

PAIRS, CAPACITY = 8, 65_536
SHARES = (0.5, 0.2, 0.1, 0.05, 0.02)
"""Shares of a pair's matches that lie on its planes, largest first."""


def _pair(rng: np.random.Generator, matches: int, planes: int) -> tuple[np.ndarray, ...]:
    """Matches on some planes among random wrong matches, and which rows are matches."""
    xy0, xy1 = rng.uniform(0, 1600, (2, CAPACITY, 2))
    first = 0
    for share in SHARES[:planes]:
        rows = slice(first, first + int(share * matches))
        linear = np.eye(2) + rng.uniform(-0.1, 0.1, (2, 2))
        noise = rng.normal(0, 1.5, xy0[rows].shape)
        xy1[rows] = xy0[rows] @ linear.T + rng.uniform(-100, 100, 2) + noise
        first = rows.stop
    order = rng.permutation(matches)
    xy0[:matches], xy1[:matches] = xy0[order], xy1[order]
    return xy0.astype(np.float32), xy1.astype(np.float32), np.arange(CAPACITY) < matches


def measure() -> Iterator[Metric]:
    """Pairs of 1,000 to 20,000 matches with none to five planes: some end early, others late."""
    rng = np.random.default_rng(0)
    pairs = [_pair(rng, int(rng.uniform(1000, 20_000)), i % 6) for i in range(PAIRS)]
    xy0, xy1, valid = (jnp.asarray(np.stack(each)) for each in zip(*pairs, strict=True))
    keys = jax.random.split(jax.random.key(0), PAIRS)
    limits = Thresholds(jnp.float32(10), jnp.int32(26), jnp.float32(0.999))

    def peel(key, xy0, xy1, valid):
        return peel_planes(key, xy0, xy1, valid, limits, shape=PRESETS["default"].pair)

    single, vmapped = jax.jit(peel), jax.jit(jax.vmap(peel))
    items = [(keys[i], xy0[i], xy1[i], valid[i]) for i in range(PAIRS)]
    batch, alone = seconds(
        lambda: vmapped(keys, xy0, xy1, valid), lambda: [single(*item) for item in items]
    )
    yield Metric("planes.batch_seconds", median(batch), "s", "lower")
    yield ratio("planes.batch_over_one_by_one", batch, alone, "lower", 0.25)
