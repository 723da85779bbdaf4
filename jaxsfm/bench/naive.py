"""The method `paper-naive`: matches of pixels without relocalization (`jaxsfm.core.naive`)."""

import functools
from collections.abc import Iterable, Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.config import Config
from jaxsfm.core.naive import match_naively
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair import pair_key
from jaxsfm.core.vgg import VGG16, preprocess
from jaxsfm.io.features import ImageFeatures, padded_size
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import thresholds, to_original_pixels

HELD = 4
"""Images whose maps are held. Those of a photo of 1536 x 1024 take 0.28 GB."""
_join = jax.jit(join_octaves)


@jax.jit
def _maps(params: dict, image: jax.Array, size: jax.Array) -> list[jax.Array]:
    """pool2, pool1 and conv1_2 of a preprocessed image, in float16."""
    found = VGG16().apply(params, image[None], size[None], method="walked")
    return [level[0].astype(jnp.float16) for level in reversed(jax.tree.leaves(found))]


def match_pairs_naively(
    weights: Weights,
    images: Mapping[str, ImageFile],
    pairs: Iterable[Pair],
    *,
    config: Config,
    seed: int,
) -> Iterator[PairResult]:
    """Yield the matches of pairs in their order. The index of a keypoint is that of its pixel."""

    @functools.lru_cache(maxsize=HELD)
    def described(name: str) -> tuple[ImageFeatures, list[jax.Array]]:
        features = image_features(weights, images[name], config=config)
        rgb = read_image(images[name], max_size=config.max_size, enlarge=config.enlarge).rgb
        height, width = rgb.shape[:2]
        padded = np.zeros((*padded_size((width, height)), 3), np.uint8)
        padded[:height, :width] = rgb
        x = preprocess(jnp.asarray(padded), weights.preprocessing)
        maps = _maps(weights.params, x, jnp.asarray([height, width], jnp.int32))
        rows, columns = np.indices(padded.shape[:2], np.float32).reshape(2, -1)
        every = features.dense._replace(keypoints=np.stack([columns, rows], axis=1))
        return features._replace(dense=every), maps

    for a, b in pairs:
        sides = [described(a), described(b)]
        found = match_naively(
            pair_key(jax.random.key(seed), images[a].identity, images[b].identity),
            tuple(_join(features.dense) for features, _ in sides),
            tuple([level.astype(jnp.float32) for level in maps] for _, maps in sides),
            thresholds(config),
            shape=config.pair,
        )
        yield to_original_pixels(jax.device_get(found), *(features for features, _ in sides))
