"""Dense features of image files, in batches over all devices."""

import dataclasses
import itertools
import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxsfm.config import Config
from jaxsfm.core.features import Extraction, Walk
from jaxsfm.core.sharded import extract_batch
from jaxsfm.core.types import DenseFeatures
from jaxsfm.io.features import (
    ImageFeatures,
    check_memory,
    feature_capacity,
    padded_size,
    without_unused,
)
from jaxsfm.io.images import ImageError, ImageFile, WorkingImage, read_image, working_size
from jaxsfm.io.libraries import announce_compilation
from jaxsfm.io.traced_programs import Traced
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import (
    ONE_AT_A_TIME,
    Execution,
    images_at_once,
    overlap_batches,
    select_devices,
)

_extract = Traced(extract_batch, DenseFeatures)

READERS = 8
"""Threads that decode images at most. A JPEG takes 20 ms, and an accelerator takes 150 images a
second."""


class _Extractor(NamedTuple):
    """What the images of one call are extracted with."""

    weights: Weights
    config: Config
    mesh: Mesh

    def shapes(self, size: tuple[int, int]) -> tuple[tuple[int, int], int]:
        """Padded size (width, height) and coarse capacity of a working image, which fix the
        program."""
        capacity = feature_capacity(size, fine_stride=self.config.fine_stride)
        return padded_size(size), capacity.num_coarse

    def start(self, working: Sequence[WorkingImage], batch_size: int) -> DenseFeatures:
        """Start the extraction of images that share a padded size and a capacity.

        The features are on the devices, with leading axes for the devices and their batches.
        """
        padded, num_coarse = self.shapes(working[0].rgb.shape[1::-1])
        count = batch_size * self.mesh.size
        images = np.zeros((count, *padded, 3), np.uint8)
        sizes = np.zeros((count, 2), np.int32)
        for k, each in enumerate(working):
            height, width = sizes[k] = each.rgb.shape[:2]
            images[k, :height, :width] = each.rgb
        return _extract(
            self.weights.params,
            self.weights.scores(self.config),
            images,
            sizes,
            mesh=self.mesh,
            settings=extraction_settings(self.weights, self.config, num_coarse),
        )


def extraction_settings(weights: Weights, config: Config, num_coarse: int) -> Extraction:
    """What a config and the weights fix in the compiled program of an extraction.

    Raises ValueError if the weights belong to another network than the config's.
    """
    if weights.backbone != config.backbone:
        raise ValueError(f"weights must be of {config.backbone}; got {weights.backbone}")
    return Extraction(
        preprocessing=weights.preprocessing,
        num_coarse=num_coarse,
        backbone=config.backbone,
        layers=config.layers,
        walk=Walk(0 if config.keypoints == "grid" else config.walked_levels, config.children),
        octaves=config.octaves,
        centred=config.centred,
        bfloat16=config.convolutions == "bfloat16",
    )


def image_features(weights: Weights, image: ImageFile, *, config: Config) -> ImageFeatures:
    """Read one image and compute its features; ImageError if it cannot be read."""
    ((_, found),) = extract_images(weights, [image], config=config, execution=ONE_AT_A_TIME)
    if isinstance(found, ImageError):
        raise found
    return found


def describe_pixels(
    weights: Weights, image: ImageFile, working: WorkingImage, *, config: Config
) -> ImageFeatures:
    """The features of pixels that have been read (`jaxsfm.io.photos`).

    Args:
      image: the photo that the pixels are from. Coordinates are mapped to the pixels of a photo of
        its size and orientation, by the scale of `working`.
    """
    announce_compilation()
    extractor = _Extractor(weights, config, select_devices(ONE_AT_A_TIME))
    ((_, found),) = _results((_Batch([(image, working)], 1), extractor.start([working], 1)))
    assert isinstance(found, ImageFeatures)
    return found


def extract_images(
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    config: Config,
    execution: Execution | None = None,
) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
    """Yield every image with its features, or with the error if it cannot be read.

    Images come batch by batch, and those of one padded size follow each other. The next images are
    read while a batch is computed. Raises UserError if an image needs more memory than there is.
    """
    execution, images = execution or Execution(), list(images)
    mesh = select_devices(execution)
    at_once = mesh.size * (execution.images_at_once or 1)
    for image in images:  # before the first is computed
        check_memory(image, at_once, config=config)
    if images:
        announce_compilation()
    params = jax.device_put(weights.params, NamedSharding(mesh, PartitionSpec()))
    extractor = _Extractor(dataclasses.replace(weights, params=params), config, mesh)

    def shapes(image: ImageFile) -> tuple[tuple[int, int], int]:
        return extractor.shapes(working_size(image.upright_size, config.max_size, config.enlarge))

    def batches() -> Iterator[_Batch]:
        for (padded, _), group in itertools.groupby(sorted(images, key=shapes), key=shapes):
            some = list(group)
            pixels = padded[0] * padded[1]
            side_by_side = images_at_once(execution, mesh, pixels, len(some))
            read = _read_ahead(some, config=config, ahead=side_by_side * mesh.size + READERS)
            while batch := list(itertools.islice(read, side_by_side * mesh.size)):
                yield _Batch(batch, side_by_side)

    def start(batch: _Batch) -> tuple[_Batch, DenseFeatures | None]:
        good = [each for _, each in batch.read if isinstance(each, WorkingImage)]
        return batch, extractor.start(good, batch.side_by_side) if good else None

    return overlap_batches(batches(), start, _results)


class _Batch(NamedTuple):
    """Images that are extracted together, and how many of them a device computes side by side."""

    read: list[tuple[ImageFile, WorkingImage | ImageError]]
    side_by_side: int


def _results(
    started: tuple[_Batch, DenseFeatures | None],
) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
    batch, found = started
    dense, k = jax.device_get(found), 0
    for image, each in batch.read:
        if isinstance(each, ImageError):
            yield image, each
        else:
            own = jax.tree.map(lambda x, k=k: x[k].copy(), dense)  # not a view of the whole batch
            if each.used is not None:
                own = without_unused(own, each.used)
            yield image, ImageFeatures(image, each.scale, own)
            k += 1


def _read_ahead(
    images: Iterable[ImageFile], *, config: Config, ahead: int
) -> Iterator[tuple[ImageFile, WorkingImage | ImageError]]:
    """Yield images in order; threads decode up to `ahead` images in advance."""

    def read(image: ImageFile) -> WorkingImage | ImageError:
        try:
            return read_image(image, max_size=config.max_size, enlarge=config.enlarge, upright=True)
        except ImageError as error:
            return error

    waiting: deque[tuple[ImageFile, Future[WorkingImage | ImageError]]] = deque()
    todo = iter(images)
    pool = ThreadPoolExecutor(min(READERS, os.cpu_count() or 1))
    try:
        while True:
            for image in itertools.islice(todo, ahead - len(waiting)):
                waiting.append((image, pool.submit(read, image)))
            if not waiting:
                return
            image, working = waiting.popleft()
            yield image, working.result()
    finally:  # an interrupted run does not wait for images that it will not use
        pool.shutdown(cancel_futures=True)
