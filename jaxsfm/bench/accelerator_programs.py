"""The programs of a preset on one device, and the operations and bytes that they need at least.

The programs are those of a run, in the batches that a run takes on the device. Their input are two
rendered photos. Operations and bytes are counted from shapes. Bytes are those of the large arrays
that do not fit into a cache: each is counted once where it is written and once for every stage that
reads it. Everything else (decoding, the host, small arrays) counts nothing.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from jaxsfm.bench.synthetic import arc, render, room
from jaxsfm.config import Config
from jaxsfm.core.coarse_to_fine import SIDE
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.core.sharded import extract_batch, join_everywhere, match_batch
from jaxsfm.core.types import PairMatches
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution, images_at_once, pairs_at_once
from jaxsfm.matching.extraction import extraction_settings
from jaxsfm.matching.pair_matching import thresholds

ENOUGH = 256
"""Images, or pairs, of which batches are made: as many as a run has at least."""
LAYERS = (
    *((3, 64, 1), (64, 64, 1)),
    *((64, 128, 4), (128, 128, 4)),
    *((128, 256, 16), (256, 256, 16), (256, 256, 16)),
    *((256, 512, 64), (512, 512, 64), (512, 512, 64)),
)
"""Convolutions of VGG-16 up to pool4: channels in, channels out, pixels of the image per cell."""
COARSE, FINE = 512, 256
"""Channels of a coarse and of a fine descriptor of one octave."""


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


class Found(NamedTuple):
    """What a pair's work depends on beside its size."""

    coarse: int
    """Mutual coarse matches."""
    tentative: int
    """Fine correspondences."""


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
    execution = Execution()
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
    return Programs(
        lambda: extraction(*put),
        lambda: matching(*arguments),
        images,
        pairs,
        _program_bytes(extraction) / images,
        _program_bytes(matching) / pairs,
        keypoints,
        once,
        Found(int(once.num_coarse), int(once.num_tentative)),
    )


def agreement(ours: Programs, cpu: Programs) -> tuple[float, float]:
    """Shares of the CPU's keypoints and matches that the device gives as well."""
    keypoints = float((ours.keypoints == cpu.keypoints).all(axis=2).mean())

    same, expected = (
        {(int(a), int(b)) for a, b in found.cells[found.plane >= 0]}
        for found in (ours.matches, cpu.matches)
    )
    return keypoints, len(expected & same) / max(len(expected), 1)


class Stage(NamedTuple):
    """What one stage needs for one image or one pair."""

    name: str
    products: float
    """Operations (a multiplication and an addition are two) in matrix products and convolutions."""
    bytes: float
    """Bytes that are read from or written to the device's memory."""


def image_work(width: int, height: int, config: Config) -> list[Stage]:
    """The stages of `jaxsfm.core.features.extract` for one image of this size.

    Keypoints and descriptors are left out: they read the network's maps once, which counts here.
    """
    size = 2 if config.convolutions == "bfloat16" else 4
    pixels = sum(width * height / 4**k for k in range(config.octaves))
    products = sum(18 * a * b * pixels / cells for a, b, cells in LAYERS)
    maps = sum(size * (a + b) * pixels / cells for a, b, cells in LAYERS)
    # The last map of each block is read by its pooling, and that of three blocks by the norms.
    read = sum(size * b * pixels / cells for _, b, cells in (LAYERS[k] for k in (1, 3, 6, 9)))
    return [Stage("network", products, maps + 2 * read)]


def pair_work(width: int, height: int, config: Config, found: Found) -> list[Stage]:
    """The stages of `jaxsfm.core.pair.match_pair` for two images of this size."""
    n, shape = feature_capacity((width, height)).num_coarse, config.pair.for_accelerators()
    size = 4.0 if config.products == "float32" else 2.0  # bytes of a channel
    tile = min(shape.coarse_tile, n)
    radius = shape.consensus
    margin = 2 * radius * (shape.coarse_columns + 1) if radius else 0
    rows, columns = -(-n // tile) * (tile + margin), n + margin  # with the neighbours of each tile
    entries = float(rows * columns)
    table = 4.0 * entries
    smaller = [octave_capacity(n, k) for k in range(1, config.octaves)]
    if radius:
        products = 2.0 * COARSE * (entries + sum(smaller) * columns)
    else:
        products = 2.0 * COARSE * config.octaves * entries
    read = 2 * size * n * COARSE * config.octaves
    stages = [Stage("coarse products", products, read + table)]
    if radius and smaller:
        # Four rows of a small table are read for every row; a tile of the sum stays in the cache.
        parts = 4.0 * sum(smaller) * columns
        stages.append(Stage("octaves", 0, 2 * parts + 2 * table))
    if radius:
        stages.append(Stage("consensus", 0, 2 * table))
    stages.append(Stage("mutual neighbours", 0, 2 * table))
    cells, channels = SIDE * SIDE, FINE * config.octaves
    gathered = 2 * cells * channels * size * found.coarse
    windows = 2.0 * cells * cells * channels * found.coarse
    # Rows are read, written next to each other, and read by the product.
    stages.append(Stage("windows", windows, 3 * gathered))
    # Nine slots per cell: built, sorted, compared, compacted.
    stages.append(Stage("correspondences", 0, 9 * 4.0 * 4 * n * 12))
    if shape.one_to_one == "similarity":
        stages.append(Stage("similarities", 0, 3 * 2 * channels * size * found.tentative))
    # Hypotheses are compared on few correspondences, which stay in the cache. A plane has about
    # three new best ones, and each is refitted until nothing is gained.
    fits = shape.max_planes * (3 * min(shape.local_refits, 2) + shape.plane_rounds)
    stages.append(Stage("refits", 0, 40.0 * found.tentative * fits))
    return stages
