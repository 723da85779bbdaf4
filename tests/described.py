"""Compute dense features of one image in float32, as they are before they are stored."""

import jax
import numpy as np

from jaxsfm.config import Config
from jaxsfm.core.features import extract
from jaxsfm.core.types import DenseFeatures
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.io.images import WorkingImage
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import extraction_settings


def compute_features(weights: Weights, working: WorkingImage, *, config: Config) -> DenseFeatures:
    height, width = working.rgb.shape[:2]
    image = np.zeros((*padded_size((width, height)), 3), np.uint8)
    image[:height, :width] = working.rgb
    num_coarse = feature_capacity((width, height)).num_coarse
    return jax.device_get(
        extract(
            weights.params,
            image,
            np.asarray([height, width], np.int32),
            settings=extraction_settings(weights, config, num_coarse),
            scores=weights.scores(config),
        )
    )
