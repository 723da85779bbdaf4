"""Operations and bytes of an image and of a pair, counted from shapes, and the times that follow.

A stage takes as long as its operations or its bytes need, whichever is more. Bytes are those of the
large arrays that do not fit into a cache: each is counted once where it is written and once for
every stage that reads it. Loops whose steps wait for each other cost at least `Device.step_s` per
step; the pairs of a batch take their steps together. Everything else (decoding, the host, small
arrays) counts nothing, so the figures are bounds and not forecasts.
"""

from typing import NamedTuple

from jaxsfm.config import Config
from jaxsfm.core.coarse_to_fine import SIDE
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.io.features import feature_capacity

LAYERS = (
    *((3, 64, 1), (64, 64, 1)),
    *((64, 128, 4), (128, 128, 4)),
    *((128, 256, 16), (256, 256, 16), (256, 256, 16)),
    *((256, 512, 64), (512, 512, 64), (512, 512, 64)),
)
"""Convolutions of VGG-16 up to pool4: channels in, channels out, pixels of the image per cell."""
COARSE, FINE = 512, 256
"""Channels of a coarse and of a fine descriptor of one octave."""
SOLVE, SCORE, REFIT = 400, 24, 120
"""Operations of `jaxsfm.core.homography`: of one minimal solution, of one correspondence under one
hypothesis, and of one correspondence in a least-squares fit with the count after it."""


class Stage(NamedTuple):
    """What one stage needs for one image or one pair."""

    name: str
    products: float
    """Operations (a multiplication and an addition are two) in matrix products and convolutions."""
    others: float
    """All other operations."""
    bytes: float
    """Bytes that are read from or written to the device's memory."""
    steps: float = 0.0
    """Steps of loops that wait for each other."""


class Device(NamedTuple):
    """An accelerator by its maker's figures."""

    name: str
    float32: float
    """Operations a second in float32 products at full precision, and outside of products."""
    half: float
    """Operations a second in products of bfloat16 with float32 sums, without sparsity."""
    bandwidth: float
    """Bytes a second."""
    step_s: float = 30e-6
    """Seconds of one step of a loop: a handful of kernels, and the condition read by the host. An
    assumption, not a maker's figure."""


DEVICES = (
    Device("H200", 67e12, 989e12, 4.8e12),
    Device("A100 80 GB", 19.5e12, 312e12, 2.0e12),
    Device("RTX 4090", 82.6e12, 165e12, 1.0e12),
    # A float32 product at full precision takes six passes of bfloat16.
    Device("TPU v5e", 197e12 / 6, 197e12, 0.82e12),
)
"""Dense rates from the makers' data sheets."""


class Found(NamedTuple):
    """What a pair's work depends on beside its size; `jaxsfm.bench.accelerator` measures it."""

    coarse: int
    """Mutual coarse matches."""
    tentative: int
    """Fine correspondences."""
    hypotheses: int
    """Hypotheses scored, over all planes."""


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
    elementwise = sum(3 * b * pixels / cells for _, b, cells in LAYERS)
    return [Stage("network", products, elementwise, maps + 2 * read)]


def pair_work(width: int, height: int, config: Config, found: Found) -> list[Stage]:
    """The stages of `jaxsfm.core.pair.match_pair` for two images of this size."""
    n, shape = feature_capacity((width, height)).num_coarse, config.pair.for_accelerators()
    tile = min(shape.coarse_tile, n)
    radius = shape.consensus
    margin = 2 * radius * (shape.coarse_columns + 1) if radius else 0
    rows, columns = -(-n // tile) * (tile + margin), n + margin  # with the neighbours of each tile
    table, entries = 4.0 * rows * columns, float(rows * columns)
    smaller = [octave_capacity(n, k) for k in range(1, config.octaves)]
    if radius:
        products = 2.0 * COARSE * (entries + sum(smaller) * columns)
    else:
        products = 2.0 * COARSE * config.octaves * entries
    stages = [Stage("coarse products", products, 0, 8.0 * n * COARSE * config.octaves + table)]
    if radius and smaller:
        # Four rows of a small table are read for every row; a tile of the sum stays in the cache.
        parts = 4.0 * sum(smaller) * columns
        stages.append(Stage("octaves", 0, 8.0 * entries * len(smaller), 2 * parts + 2 * table))
    if radius:
        votes = (2 * radius + 1) ** 2
        stages.append(Stage("consensus", 0, 3.0 * entries * votes, 2 * table))
    stages.append(Stage("mutual neighbours", 0, 4.0 * entries, 2 * table))
    cells, channels = SIDE * SIDE, FINE * config.octaves
    gathered = 2 * cells * channels * 4.0 * found.coarse
    windows = 2.0 * cells * cells * channels * found.coarse
    chunks = found.coarse / shape.fine_chunk
    # Rows are read, written next to each other, and read by the product.
    stages.append(Stage("windows", windows, 4.0 * cells**2 * found.coarse, 3 * gathered, chunks))
    # Nine slots per cell: built, sorted, compared, compacted.
    stages.append(Stage("correspondences", 0, 9.0 * 4 * n * 30, 9 * 4.0 * 4 * n * 12))
    if shape.one_to_one == "similarity":
        rows = 2 * channels * 4.0 * found.tentative
        products = 2.0 * channels * found.tentative
        steps = found.tentative / 512
        stages.append(Stage("similarities", 0, products, 3 * rows, steps))
    # Every hypothesis is scored on all correspondences: later planes have fewer.
    hypotheses, k = found.hypotheses, found.tentative
    # The stopping rule looks at every step; samples are drawn and scored several steps at once.
    looks = hypotheses / shape.hypotheses_per_step
    batches = looks / shape.steps_at_once
    chunks = batches * max(k / shape.score_chunk, 1)
    operations = (SOLVE + SCORE * k) * hypotheses
    steps = looks + batches + chunks
    stages.append(Stage("hypotheses", 0, operations, 16.0 * k * batches, steps))
    # A plane has about three new best hypotheses, and each is refitted until nothing is gained.
    fits = shape.max_planes * (3 * min(shape.local_refits, 2) + shape.plane_rounds)
    stages.append(Stage("refits", 0, REFIT * k * fits, 40.0 * k * fits, fits))
    return stages


def seconds(stages: list[Stage], device: Device, *, batch: int = 1, half: bool = False) -> float:
    """The least time of one image or pair on a device.

    Args:
      batch: number of pairs that take the steps of their loops together.
      half: products take bfloat16 and sum in float32.
    """
    rate = device.half if half else device.float32
    return sum(
        max(stage.products / rate + stage.others / device.float32, stage.bytes / device.bandwidth)
        + stage.steps * device.step_s / batch
        for stage in stages
    )
