"""Operations and bytes of an image and of a pair, counted from shapes, and the times that follow.

A stage takes as long as its operations or its bytes need, whichever is more. Bytes are those of the
large arrays that do not fit into a cache: each is counted once where it is written and once for
every stage that reads it. Loops whose steps wait for each other cost at least `Device.step_s` per
step; the pairs of a batch take their steps together. Everything else (decoding, the host, small
arrays) counts nothing, so the figures are bounds and not forecasts.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple, get_args

from jaxsfm.config import Config, Convolutions, preset
from jaxsfm.core.coarse_to_fine import SIDE
from jaxsfm.core.octaves import octave_capacity
from jaxsfm.io.features import feature_capacity
from jaxsfm.matching.execution import fitting_pairs

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
    half: bool = False
    """Whether the products take numbers of 16 bits; they sum in float32."""


class Device(NamedTuple):
    """An accelerator by its maker's figures."""

    name: str
    float32: float
    """Operations a second in float32 products at full precision, and outside of products."""
    half: float
    """Operations a second in products of 16-bit numbers with float32 sums, without sparsity."""
    bandwidth: float
    """Bytes a second."""
    memory: float
    """Bytes that JAX uses: three quarters of a GPU's memory, unless it is told otherwise."""
    step_s: float = 30e-6
    """Seconds of one step of a loop: a handful of kernels, and the condition read by the host. An
    assumption, not a maker's figure."""


DEVICES = (
    Device("H200", 67e12, 989e12, 4.8e12, 0.75 * 141e9),
    Device("A100 80 GB", 19.5e12, 312e12, 2.0e12, 0.75 * 80e9),
    Device("RTX 4090", 82.6e12, 165e12, 1.0e12, 0.75 * 24e9),
    # A float32 product at full precision takes six passes of bfloat16.
    Device("TPU v5e", 197e12 / 6, 197e12, 0.82e12, 16e9),
)
"""Dense rates and memory from the makers' data sheets."""


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
    half = config.convolutions == "bfloat16"
    size = 2 if half else 4
    pixels = sum(width * height / 4**k for k in range(config.octaves))
    products = sum(18 * a * b * pixels / cells for a, b, cells in LAYERS)
    maps = sum(size * (a + b) * pixels / cells for a, b, cells in LAYERS)
    # The last map of each block is read by its pooling, and that of three blocks by the norms.
    read = sum(size * b * pixels / cells for _, b, cells in (LAYERS[k] for k in (1, 3, 6, 9)))
    elementwise = sum(3 * b * pixels / cells for _, b, cells in LAYERS)
    return [Stage("network", products, elementwise, maps + 2 * read, half=half)]


def pair_work(width: int, height: int, config: Config, found: Found) -> list[Stage]:
    """The stages of `jaxsfm.core.pair.match_pair` for two images of this size."""
    n, shape = feature_capacity((width, height)).num_coarse, config.pair.for_accelerators()
    half = config.products != "float32"
    size = 2.0 if half else 4.0  # bytes of a channel
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
    read = 2 * size * n * COARSE * config.octaves
    stages = [Stage("coarse products", products, 0, read + table, half=half)]
    if radius and smaller:
        # Four rows of a small table are read for every row; a tile of the sum stays in the cache.
        parts = 4.0 * sum(smaller) * columns
        stages.append(Stage("octaves", 0, 8.0 * entries * len(smaller), 2 * parts + 2 * table))
    if radius:
        votes = (2 * radius + 1) ** 2
        stages.append(Stage("consensus", 0, 3.0 * entries * votes, 2 * table))
    stages.append(Stage("mutual neighbours", 0, 4.0 * entries, 2 * table))
    cells, channels = SIDE * SIDE, FINE * config.octaves
    gathered = 2 * cells * channels * size * found.coarse
    windows = 2.0 * cells * cells * channels * found.coarse
    chunks = found.coarse / shape.fine_chunk
    # Rows are read, written next to each other, and read by the product.
    others = 4.0 * cells**2 * found.coarse
    stages.append(Stage("windows", windows, others, 3 * gathered, chunks, half))
    # Nine slots per cell: built, sorted, compared, compacted.
    stages.append(Stage("correspondences", 0, 9.0 * 4 * n * 30, 9 * 4.0 * 4 * n * 12))
    if shape.one_to_one == "similarity":
        rows = 2 * channels * size * found.tentative
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


def seconds(stages: list[Stage], device: Device, *, batch: int = 1) -> float:
    """The least time of one image or pair on a device.

    Args:
      batch: number of pairs that take the steps of their loops together.
    """

    def least(stage: Stage) -> float:
        products = stage.products / (device.half if stage.half else device.float32)
        return max(products + stage.others / device.float32, stage.bytes / device.bandwidth)

    return sum(least(stage) + stage.steps * device.step_s / batch for stage in stages)


def in_numbers(config: Config, numbers: Convolutions) -> Config:
    """The config with convolutions and products of descriptors of this type."""
    return dataclasses.replace(config, convolutions=numbers, products=numbers)


def paper_lines(found: Mapping[str, Found], size: tuple[int, int]) -> list[str]:
    """What the devices could do at most, as a table in Markdown.

    Args:
      found: for each preset what the work of a pair depends on.
      size: (width, height) of the photos.
    """
    num_coarse = feature_capacity(size).num_coarse
    lines = ["| on paper, a second | " + " | ".join(d.name for d in DEVICES) + " |"]
    lines.append("|" + "---|" * (len(DEVICES) + 1))
    for name, counts in found.items():
        for numbers in get_args(Convolutions):
            config = in_numbers(preset(name), numbers)
            images, pairs = image_work(*size, config), pair_work(*size, config, counts)
            together = [fitting_pairs(d.memory, num_coarse, config=config) for d in DEVICES]
            for what, rates in (
                ("images", [1 / seconds(images, d) for d in DEVICES]),
                ("pairs, one at a time", [1 / seconds(pairs, d) for d in DEVICES]),
                ("pairs, as many at once as fit", [
                    1 / seconds(pairs, d, batch=n) for d, n in zip(DEVICES, together, strict=True)
                ]),
            ):  # fmt: skip
                lines.append(f"| {name}, {numbers}, {what} | {' | '.join(map(rate_text, rates))} |")
            cells = " | ".join(map(str, together))
            lines.append(f"| {name}, {numbers}, pairs that fit | {cells} |")
    return lines


def rate_text(x: float) -> str:
    """Three digits, or all of a larger number."""
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"
