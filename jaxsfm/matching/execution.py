"""How the compiled programs run: devices, batches, memory. Never what they give, up to rounding:
with more than one item side by side on a device, the last place of a product may differ.

Everything here follows from the machine, the images' sizes and how many there are, not from what is
free at the moment.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxsfm.config import Config
from jaxsfm.core.backbones import BACKBONES
from jaxsfm.core.octaves import join_octaves, octave_capacity
from jaxsfm.core.sharded import device_mesh
from jaxsfm.core.types import DenseFeatures
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.features import total_memory
from jaxsfm.options import ExecutionChoice

HOST_SHARE, DEVICE_SHARE = 1 / 8, 1 / 2
"""Of a machine's memory, or of an accelerator's, that joined features may take."""
HOST_BYTES = 3 << 29
"""And at most this of a host's: ten images of 1536 x 1024 with four octaves."""
HOST_IMAGES = 32
"""And so many images: with them one is loaded for eight pairs of all, and what a run of a hundred
small photos takes is what one of a thousand takes."""
MAX_IMAGES, MAX_PAIRS = 16, 64
"""Side by side on an accelerator; more keep it no busier, but wait longer for the slowest."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Execution(ExecutionChoice):
    """How many devices are used, how large batches are, and how much memory features may take.

    The fields are those of `jaxsfm.options.ExecutionChoice`, checked.

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


SINGLE = Execution(devices=1, images_at_once=1, pairs_at_once=1)
"""For one image or one pair."""


def chosen_devices(execution: Execution) -> Mesh:
    """The devices to use, in a row.

    Raises:
      UserError: there are not so many.
    """
    devices = jax.local_devices()
    if execution.devices is not None and execution.devices > len(devices):
        raise UserError(
            f"--devices {execution.devices}: there are {len(devices)} ({devices[0].platform})"
        )
    return device_mesh(devices[: execution.devices])


def _device_memory(mesh: Mesh) -> int | None:
    """Bytes that JAX may use on each accelerator; None for CPUs, or where it does not tell."""
    device = mesh.devices.flat[0]
    stats = None if device.platform == "cpu" else device.memory_stats()
    return stats.get("bytes_limit") if stats else None


def _bytes(tree: Any) -> int:
    return sum(int(np.prod(x.shape)) * x.dtype.itemsize for x in jax.tree.leaves(tree))


def joined_bytes(num_coarse: int, *, octaves: int, backbone: str = "vgg16") -> int:
    """Of one image's joined features, of VGG about 98 per working pixel with four octaves, 24 with
    one."""
    network = BACKBONES[backbone]

    def blank() -> DenseFeatures:
        def octave(cells: int, channels: int) -> tuple[jax.Array, ...]:
            rooms = (octave_capacity(cells, k) for k in range(octaves))
            return tuple(jnp.zeros((room, channels)) for room in rooms)

        coarse, fine = octave(num_coarse, network.coarse), octave(4 * num_coarse, network.fine)
        grid = jnp.zeros(2, jnp.int32)
        return DenseFeatures(coarse, fine, jnp.zeros((4 * num_coarse, 2)), grid, grid)

    return _bytes(jax.eval_shape(lambda: join_octaves(blank())))


def resident_images(execution: Execution, mesh: Mesh, num_coarse: int, *, config: Config) -> int:
    """How many images' joined features stay on each device, at least the two of a pair."""
    each = joined_bytes(num_coarse, octaves=config.octaves, backbone=config.backbone)
    memory = _device_memory(mesh)
    if execution.memory_gb is not None:
        most = execution.memory_gb * 1e9 / each
    elif memory is not None:
        most = DEVICE_SHARE * memory / each
    else:
        budget = min(HOST_BYTES, HOST_SHARE * (total_memory() or HOST_BYTES / HOST_SHARE))
        most = min(budget / mesh.size / each, HOST_IMAGES)
    return max(2, int(most))


ACCELERATOR_BYTES_PER_PIXEL = 3000
"""Of an extraction where the largest maps exist whole: the compiler's own account for CPUs was
1540, and a library's convolutions want room of their own. Not measured on a GPU yet."""


def images_at_once(execution: Execution, mesh: Mesh, pixels: int, count: int) -> int:
    """Images extracted side by side on each device.

    Args:
      pixels: of one padded image.
      count: images there are of that size.
    """
    each = ACCELERATOR_BYTES_PER_PIXEL * pixels
    return _at_once(execution.images_at_once, mesh, DEVICE_SHARE, each, MAX_IMAGES, count)


def _at_once(asked: int | None, mesh: Mesh, share: float, each: int, most: int, count: int) -> int:
    """Items side by side on a device: as asked for, else what fits into a share of its memory (one
    on a CPU); no more than each device gets of `count`, up to a power of two, so that few programs
    are compiled."""
    memory = _device_memory(mesh)
    if asked is None:
        asked = 1 if memory is None else int(np.clip(share * memory / each, 1, most))
    own = -(-count // mesh.size)
    return min(asked, 1 << (own - 1).bit_length())


PAIR_BYTES_PER_CELL = 35_000
"""Working memory of a pair per coarse cell, alone or side by side: the compiler's own account of
`default`'s program at 1600 x 1200; `paper` takes 13 000."""


def pairs_at_once(
    execution: Execution, mesh: Mesh, num_coarse: int, count: int, *, config: Config
) -> int:
    """Pairs matched side by side on each device, of `count`."""
    # A batch copies both sides of its pairs, in half of what the images at hand leave.
    share = (1 - DEVICE_SHARE) / 2
    joined = joined_bytes(num_coarse, octaves=config.octaves, backbone=config.backbone)
    each = 2 * joined + PAIR_BYTES_PER_CELL * num_coarse
    return _at_once(execution.pairs_at_once, mesh, share, each, MAX_PAIRS, count)


Batch = TypeVar("Batch")
Started = TypeVar("Started")
Result = TypeVar("Result")


def one_ahead(
    batches: Iterable[Batch],
    start: Callable[[Batch], Started],
    finish: Callable[[Started], Iterable[Result]],
) -> Iterator[Result]:
    """Results of batches, of which one runs on the devices while the next is loaded (`batches` is
    asked for it) and the one before is handed out.

    Whatever goes wrong with the next (Ctrl-C, a photo that went away, no memory): what has been
    started is finished and handed out first.
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
