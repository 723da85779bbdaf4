"""How the compiled programs run: on which devices, in which batches, with how much memory.

Nothing here changes a result, up to rounding: with more than one item side by side on a device, a
product may differ in its last place. Everything follows from the machine, the images' sizes and
their number, not from what memory is free at the moment.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxsfm.config import Config
from jaxsfm.core.features import BACKBONES
from jaxsfm.core.octaves import join_octaves, octave_capacity
from jaxsfm.core.sharded import device_mesh
from jaxsfm.core.types import DenseFeatures
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.libraries import total_memory
from jaxsfm.options import ExecutionChoice

HOST_SHARE, DEVICE_SHARE = 1 / 8, 1 / 2
"""Shares of a host's memory, and of an accelerator's, that joined features may take."""
HOST_BYTES = 3 << 29
"""Joined features take at most so much of a host's memory: ten images of 1536 x 1024 with four
octaves."""
HOST_IMAGES = 32
"""At most so many images' joined features are held on a host. With 32, one image is loaded for
eight pairs if all pairs are matched, and a thousand small photos take no more memory than a
hundred."""
MAX_IMAGES, MAX_PAIRS = 16, 256
"""Items side by side on an accelerator at most. Pairs of small photos gain from company, because
each step of RANSAC starts some thirty small kernels for all of them together: an H200 matches 715,
825, 1010 and 1192 pairs of 400 x 300 a second with 64, 128, 256 and 512 side by side. The last
batch is filled up with copies, so a run of some hundred pairs gains little from more than 256."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Execution(ExecutionChoice):
    """The fields of `jaxsfm.options.ExecutionChoice`, checked.

    Raises:
      ValueError: a number that is not positive, or not finite.
    """

    def __post_init__(self) -> None:
        for name in ("devices", "images_at_once", "pairs_at_once"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1; got {value}")
        if self.memory_gb is not None and not 0 < self.memory_gb < math.inf:
            raise ValueError(f"memory_gb must be positive; got {self.memory_gb}")


ONE_AT_A_TIME = Execution(devices=1, images_at_once=1, pairs_at_once=1)
"""The execution for a single image or a single pair."""


def select_devices(execution: Execution) -> Mesh:
    """The devices that are used, as a mesh with one axis. UserError if there are too few."""
    devices = jax.local_devices()
    if execution.devices is not None and execution.devices > len(devices):
        raise UserError(
            f"--devices {execution.devices}: there are {len(devices)} ({devices[0].platform})"
        )
    return device_mesh(devices[: execution.devices])


def _device_memory(mesh: Mesh) -> int | None:
    """Bytes that JAX may use on each accelerator; None for CPUs, or if JAX does not know."""
    device = mesh.devices.flat[0]
    stats = None if device.platform == "cpu" else device.memory_stats()
    return stats.get("bytes_limit") if stats else None


@functools.cache  # tracing takes a tenth of the time of a pair's passes otherwise
def joined_bytes(num_coarse: int, *, config: Config) -> int:
    """Bytes of one image's joined features, padded to `num_coarse` cells in the first octave.

    With VGG and products in float32 they are about 98 bytes per working pixel with four octaves,
    and 24 with one.
    """
    network, octaves = BACKBONES[config.backbone], config.octaves

    def blank() -> DenseFeatures:
        def octave(cells: int, channels: int) -> tuple[jax.Array, ...]:
            sizes = (octave_capacity(cells, k) for k in range(octaves))
            return tuple(jnp.zeros((size, channels)) for size in sizes)

        coarse, fine = octave(num_coarse, network.coarse), octave(4 * num_coarse, network.fine)
        grid = jnp.zeros(2, jnp.int32)
        return DenseFeatures(coarse, fine, jnp.zeros((4 * num_coarse, 2)), grid, grid)

    shapes = jax.tree.leaves(
        jax.eval_shape(lambda: join_octaves(blank(), products=config.products))
    )
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in shapes)


def cached_images(execution: Execution, mesh: Mesh, num_coarse: int, *, config: Config) -> int:
    """How many images' joined features stay on each device: at least the two of a pair."""
    each = joined_bytes(num_coarse, config=config)
    memory = _device_memory(mesh)
    if execution.memory_gb is not None:
        most = execution.memory_gb * 1e9 / each
    elif memory is not None:
        most = DEVICE_SHARE * memory / each
    else:
        budget = min(HOST_BYTES, HOST_SHARE * total_memory())
        most = min(budget / mesh.size / each, HOST_IMAGES)
    return max(2, int(most))


ACCELERATOR_BYTES_PER_PIXEL = 3000
"""Working memory of an extraction, bytes per pixel of the padded image. XLA's own account for CPUs
was 1540, with the largest feature maps whole; the convolutions of GPU libraries need more. It has
not been measured on a GPU yet."""


def images_at_once(execution: Execution, mesh: Mesh, pixels: int, count: int) -> int:
    """How many of `count` images of `pixels` pixels, padded, each device extracts side by side.

    It is the number that was asked for; else as many as fit into the device's memory, or one on a
    CPU. It is no more than a device's part of `count`, rounded up to a power of two so that few
    programs are compiled.
    """
    asked, memory = execution.images_at_once, _device_memory(mesh)
    if asked is None:
        each = ACCELERATOR_BYTES_PER_PIXEL * pixels
        asked = 1 if memory is None else _fitting(DEVICE_SHARE * memory, each, MAX_IMAGES)
    return min(asked, _own_part(count, mesh))


def _fitting(memory: float, each: float, most: int) -> int:
    """How many items fit into memory, from 1 to `most`."""
    return int(np.clip(memory / each, 1, most))


def _own_part(count: int, mesh: Mesh) -> int:
    """A device's part of `count` items, rounded up to a power of two."""
    return 1 << (-(-count // mesh.size) - 1).bit_length()


PAIR_BYTES_PER_CELL = 35_000
"""Working memory of a pair, bytes per coarse cell, alone or side by side with others. It is XLA's
own account of the program of the preset `default` at 1600 x 1200; `paper` takes 13 000."""


def pairs_at_once(
    execution: Execution, mesh: Mesh, num_coarse: int, count: int, *, config: Config
) -> int:
    """How many of `count` pairs each device matches side by side, as in `images_at_once`.

    A batch copies both sides of its pairs, into half of the memory that cached images leave.
    """
    asked, memory = execution.pairs_at_once, _device_memory(mesh)
    if asked is None:
        asked = 1
        if memory is not None:
            each = 2 * joined_bytes(num_coarse, config=config) + PAIR_BYTES_PER_CELL * num_coarse
            asked = _fitting((1 - DEVICE_SHARE) / 2 * memory, each, MAX_PAIRS)
    return min(asked, _own_part(count, mesh))


Batch = TypeVar("Batch")
Started = TypeVar("Started")
Result = TypeVar("Result")


def overlap_batches(
    batches: Iterable[Batch],
    start: Callable[[Batch], Started],
    finish: Callable[[Started], Iterable[Result]],
) -> Iterator[Result]:
    """Yield the results of batches, while loading, computing and saving overlap.

    While a batch runs on the devices, the next one is taken from `batches`, which loads it, and the
    results of the one before are yielded. Whatever goes wrong with the next batch (Ctrl-C, a photo
    that is gone, too little memory), the batch that runs is finished and yielded first.

    Args:
      batches: loads a batch when it is asked for the next one.
      start: starts a batch on the devices and returns arrays without waiting for them.
      finish: waits for a batch that was started, and yields its results.
    """
    todo = iter(batches)
    running: list[Started] = []
    while True:
        try:
            interrupt.check()
            batch = next(todo, None)
            if batch is None:
                break
            jax.block_until_ready(running)
            started = start(batch)
        except BaseException:
            for last in running:
                yield from finish(last)
            raise
        done, running = running, [started]
        for last in done:
            yield from finish(last)
    for last in running:
        yield from finish(last)
