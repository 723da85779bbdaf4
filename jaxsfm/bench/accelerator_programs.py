"""The programs of a preset on one device, with two rendered photos as their input.

They are those of a run, in the batches that a run takes on the device.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from jaxsfm.bench.on_paper import Found
from jaxsfm.bench.synthetic import arc, render, room
from jaxsfm.config import Config
from jaxsfm.core.pair import pair_key
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.sharded import extract_batch, join_everywhere, match_batch
from jaxsfm.core.types import PairMatches
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution, images_at_once, pairs_at_once
from jaxsfm.matching.extraction import extraction_settings
from jaxsfm.matching.pair_matching import thresholds

ENOUGH = 256
"""Images, or pairs, of which batches are made: as many as a run has at least."""


class PaddedPhotos(NamedTuple):
    """Two padded photos, as a run gives them to the device."""

    images: np.ndarray
    """uint8 (2, rows, columns, 3)."""
    size: np.ndarray
    """Valid (rows, columns)."""
    num_coarse: int


def rendered_photos(width: int, height: int) -> PaddedPhotos:
    """Two neighbouring views of the rendered room."""
    views = [render(room(), arc(7)[k], (width, height)) for k in (2, 3)]
    rows, columns = padded_size((width, height))
    images = np.zeros((2, rows, columns, 3), np.uint8)
    images[:, :height, :width] = views
    size = np.asarray([height, width], np.int32)
    return PaddedPhotos(images, size, feature_capacity((width, height)).num_coarse)


class Programs(NamedTuple):
    """The programs of one preset on one device, ready to be called."""

    extract: Callable[[], object]
    match: Callable[[], object]
    images: int
    """Number of photos in a batch."""
    pairs: int
    """Number of pairs in a batch."""
    bytes_per_image: float
    bytes_per_pair: float
    keypoints: np.ndarray
    """The keypoints of both photos, (2, cells, 2)."""
    matches: PairMatches
    """The matches of the first pair, on the host."""
    found: Found


def _program_bytes(compiled: jax.stages.Compiled) -> float:
    memory = compiled.memory_analysis()
    return float(memory.temp_size_in_bytes + memory.output_size_in_bytes) if memory else 0.0


def compiled_programs(
    weights: Weights, config: Config, photos: PaddedPhotos, mesh: Mesh
) -> Programs:
    """Compile the programs of a preset for the first device of a mesh, and run each once."""
    execution, device = Execution(), mesh.devices.flat[0]
    pixels = photos.images.shape[1] * photos.images.shape[2]
    images = images_at_once(execution, mesh, pixels, ENOUGH)
    pairs = pairs_at_once(execution, mesh, photos.num_coarse, ENOUGH, config=config)
    settings = extraction_settings(weights, config, photos.num_coarse)
    inputs = photos.images[np.arange(images) % 2], np.tile(photos.size, (images, 1))
    put = jax.device_put(
        (weights.params, weights.scores(config), *inputs),
        jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec()),
    )
    extraction = extract_batch.lower(*put, mesh=mesh, settings=settings).compile()
    both = [
        extract_batch(*put[:2], photos.images[[k]], photos.size[None], mesh=mesh, settings=settings)
        for k in (0, 1)
    ]
    joined = [
        join_everywhere(jax.tree.map(lambda x: x[0], dense), mesh=mesh, products=config.products)
        for dense in both
    ]
    ids = np.asarray([[[k, k + 1] for k in range(pairs)]], np.uint32)
    arguments = (jax.random.key(0), ids, ((joined[0], joined[1]),) * pairs, thresholds(config))
    matching = match_batch.lower(*arguments, mesh=mesh, shape=config.pair).compile()
    once = jax.tree.map(lambda x: np.asarray(x[0, 0]), matching(*arguments))
    keypoints = np.stack([np.asarray(dense.keypoints[0]) for dense in both])
    with jax.default_device(device):
        found = _found(once, keypoints, config)
    return Programs(
        lambda: extraction(*put),
        lambda: matching(*arguments),
        images,
        pairs,
        _program_bytes(extraction) / images,
        _program_bytes(matching) / pairs,
        keypoints,
        once,
        found,
    )


def _found(matches: PairMatches, keypoints: np.ndarray, config: Config) -> Found:
    tentative = int(matches.num_tentative)
    xy0, xy1 = (keypoints[side][matches.cells[:, side]] for side in (0, 1))
    planes = jax.jit(peel_planes, static_argnames="shape")(
        pair_key(jax.random.key(0), 0, 1),
        xy0,
        xy1,
        np.arange(len(xy0)) < tentative,
        thresholds(config),
        shape=config.pair,
    )
    return Found(int(matches.num_coarse), tentative, int(np.sum(planes.num_hypotheses)))


def agreement(ours: Programs, cpu: Programs) -> tuple[float, float]:
    """Shares of the CPU's keypoints and matches that the device gives as well."""
    keypoints = float((ours.keypoints == cpu.keypoints).all(axis=2).mean())

    same, expected = (
        {(int(a), int(b)) for a, b in found.cells[found.plane >= 0]}
        for found in (ours.matches, cpu.matches)
    )
    return keypoints, len(expected & same) / max(len(expected), 1)
