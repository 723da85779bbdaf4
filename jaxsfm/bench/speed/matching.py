"""Speed of mutual nearest neighbours next to FAISS, and of whole pairs.

The time of a pair is compared with that of one matrix product, which no matching can avoid.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.bench.speed.timing import Metric, median, ratio, seconds
from jaxsfm.config import preset
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.numerics import HIGHEST, unit
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair import match_pair
from jaxsfm.io.images import inspect_image
from jaxsfm.io.weights import load_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import thresholds

CELLS, CHANNELS = 6144, 512
"""The size of pool4 at 1536 x 1024."""


@jax.jit
def _product(a, b):
    return jnp.einsum("nc,mc->nm", a, b, precision=HIGHEST)


def _descriptors(seed: int) -> jax.Array:
    return unit(jax.random.normal(jax.random.key(seed), (CELLS, CHANNELS)))


def _faiss(a: np.ndarray, b: np.ndarray) -> Callable[[], np.ndarray] | None:
    try:
        import faiss  # pyright: ignore[reportMissingImports] # optional: the extra `bench`
    except ImportError:
        return None
    there, back = faiss.IndexFlatIP(CHANNELS), faiss.IndexFlatIP(CHANNELS)
    there.add(b)
    back.add(a)

    def run() -> np.ndarray:
        nearest, home = there.search(a, 1)[1][:, 0], back.search(b, 1)[1][:, 0]
        return np.where(home[nearest] == np.arange(len(a)), nearest, -1)

    return run


def measure_mutual() -> Iterator[Metric]:
    """Time with random unit descriptors; it does not depend on their values."""
    a, b = _descriptors(0), _descriptors(1)
    faiss = _faiss(np.asarray(a), np.asarray(b))
    nn = jax.jit(mutual_nn)
    ours, product, *theirs = seconds(
        lambda: nn(a, b), lambda: _product(a, b), *([faiss] if faiss else [])
    )
    yield Metric("mutual_nn.seconds", median(ours), "s", "lower")
    yield ratio("mutual_nn.over_its_product", ours, product, "lower", 0.2)
    if faiss is not None:
        yield ratio("mutual_nn.speed_over_faiss", theirs[0], ours, "higher", 0.2)
        same = float((np.asarray(nn(a, b)) == faiss()).mean())
        yield Metric("mutual_nn.same_as_faiss", same, "of the rows", "higher", 0.001)


def measure_pairs(data: Path) -> Iterator[Metric]:
    """Time of the pair 0004-0005 of fountain-P11 at 1536 x 1024."""
    folder = data / "strecha" / "fountain-P11" / "images"
    found = sorted(path for path in folder.glob("*") if path.stem in ("0004", "0005"))
    if len(found) != 2:
        print(f"skipped: pairs (no {folder}/0004.* and 0005.*)")
        return
    weights = load_weights()
    a, b = _descriptors(0), _descriptors(1)
    join = jax.jit(join_octaves)
    for name in ("paper", "default"):
        config = dataclasses.replace(preset(name), max_size=1536)
        shape = dataclasses.replace(config.pair, max_hypotheses=2048)
        dense = [
            join(image_features(weights, inspect_image(path), config=config).dense)
            for path in found
        ]
        limits = thresholds(config)

        def pair(dense=dense, limits=limits, shape=shape):
            return match_pair(jax.random.key(0), *dense, limits, shape=shape)

        ours, product = seconds(pair, lambda: _product(a, b))
        result = pair()
        yield Metric(f"pair.{name}.seconds", median(ours), "s", "lower")
        yield ratio(f"pair.{name}.over_coarse_product", ours, product, "lower", 0.25)
        verified = int((result.plane >= 0).sum())
        yield Metric(f"pair.{name}.matches", verified, "matches", "higher", 0.02)
