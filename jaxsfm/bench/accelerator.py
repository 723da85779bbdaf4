"""Speed of features and pairs on whatever device JAX has, and what the device could do at most.

    python -m jaxsfm.bench.accelerator --json accelerator.json

Two views of a rendered room are the photos. Features and pairs run in the batches that a run takes
on this device. Their rates are compared with the device's own rates of matrix products and of
memory, which are measured in the same run, by counted operations and bytes
(`jaxsfm.bench.accelerator_programs`). On an accelerator the results are compared with those of the
CPU.
"""

import dataclasses
import functools
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple, get_args

import jax
import jax.numpy as jnp
import tyro

from jaxsfm.bench.accelerator_programs import (
    Found,
    PaddedPhotos,
    Stage,
    agreement,
    compiled_programs,
    image_work,
    pair_work,
    rendered_photos,
)
from jaxsfm.bench.figures import write_json
from jaxsfm.config import Config, Convolutions, preset
from jaxsfm.core.numerics import descriptor_products
from jaxsfm.core.sharded import device_mesh
from jaxsfm.io.weights import Weights, load_weights

REPEAT = 5
"""How often each thing is timed."""
SIDE, STREAM_ENTRIES = 3072, 1 << 26
"""The side of the matrices and the entries of the array by which a CPU's own rates are measured."""


class Rates(NamedTuple):
    """What a device does at most, measured."""

    products: dict[str, float]
    """Operations a second in products of float32 at full precision, and of bfloat16."""
    bytes: float
    """Bytes a second that are read and written."""


class Measured(NamedTuple):
    """Images or pairs of one preset on one device."""

    what: str
    preset: str
    numbers: Convolutions
    """Type of the numbers in convolutions and in products of descriptors."""
    at_once: int
    """How many the device computes side by side."""
    per_second: float
    products: float
    """Share of the device's own rate of products, by the counted operations."""
    memory: float
    """Share of the device's own bandwidth, by the counted bytes."""
    megabytes: float
    """Memory of the program for one image or pair, by the compiler's account."""
    same_as_cpu: float | None
    """Share of keypoints, or of matches, that the CPU gives as well; None on a CPU."""
    stages: list[Stage]
    """The counted work."""


def median_seconds(*work: Callable[[], object]) -> list[float]:
    """The median time of each function.

    The functions run in turns, so that a slow minute of the machine affects all of them. The first
    call of each function compiles and is not counted.
    """
    for function in work:
        jax.block_until_ready(function())
    times: list[list[float]] = [[] for _ in work]
    for _ in range(REPEAT):
        for function, own in zip(work, times, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(function())
            own.append(time.perf_counter() - start)
    return [statistics.median(own) for own in times]


def device_rates() -> Rates:
    """Matrix products and memory of the default device."""
    # An accelerator gets larger arrays, so that starting the work takes no time in comparison.
    cpu = jax.default_backend() == "cpu"
    side, entries = (SIDE, STREAM_ENTRIES) if cpu else (8192, 8 * STREAM_ENTRIES)
    square = jax.random.normal(jax.random.key(0), (side, side))
    half, row = square.astype("bfloat16"), jnp.zeros(entries, jnp.float32)
    product = jax.jit(functools.partial(descriptor_products, "ij,jk->ik"))
    add_one = jax.jit(lambda a: a + 1)  # reads and writes every entry once
    *times, stream = median_seconds(
        lambda: product(square, square), lambda: product(half, half), lambda: add_one(row)
    )
    rates = [2.0 * side**3 / each for each in times]
    products = dict(zip(get_args(Convolutions), rates, strict=True))
    return Rates(products, 2 * row.nbytes / stream)


def measure(
    weights: Weights, name: str, config: Config, photos: PaddedPhotos, rates: Rates
) -> tuple[list[Measured], Found]:
    """Images and pairs of one preset on the first device, and what the pair's work depends on."""
    first = jax.devices()[0]
    programs = compiled_programs(weights, config, photos, device_mesh([first]))
    same: list[float | None] = [None, None]
    if first.platform != "cpu":
        cpu = compiled_programs(weights, config, photos, device_mesh(jax.devices("cpu")[:1]))
        same = list(agreement(programs, cpu))
    extraction, matching = median_seconds(programs.extract, programs.match)
    height, width = map(int, photos.size)
    rows = []
    for what, seconds, at_once, used, stages, equal in (
        ("images", extraction, programs.images, programs.bytes_per_image,
         image_work(width, height, config), same[0]),
        ("pairs", matching, programs.pairs, programs.bytes_per_pair,
         pair_work(width, height, config, programs.found), same[1]),
    ):  # fmt: skip
        each = seconds / at_once
        rows.append(
            Measured(
                what=what,
                preset=name,
                numbers=config.convolutions,
                at_once=at_once,
                per_second=1 / each,
                products=sum(s.products for s in stages) / each / rates.products[config.products],
                memory=sum(s.bytes for s in stages) / each / rates.bytes,
                megabytes=used / 1e6,
                same_as_cpu=equal,
                stages=stages,
            )
        )
    return rows, programs.found


def table_head() -> str:
    """The two lines of Markdown above the measured figures."""
    heads = ("preset", "numbers", "what", "at once", "a second", "products", "memory", "MB each")
    heads = (*heads, "as the CPU")
    return "| " + " | ".join(heads) + " |\n|" + "---|" * len(heads)


def table_line(row: Measured) -> str:
    """The measured figures as a line of the table."""
    same = "" if row.same_as_cpu is None else f"{row.same_as_cpu:.2%}"
    rate = f"{row.per_second:.0f}" if row.per_second >= 100 else f"{row.per_second:.3g}"
    return (
        f"| {row.preset} | {row.numbers} | {row.what} | {row.at_once} | "
        f"{rate} | {row.products:.0%} | {row.memory:.0%} | "
        f"{row.megabytes:.0f} | {same} |"
    )


def main(
    size: tuple[int, int] = (1600, 1200),
    presets: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PRESET")] = ("paper", "default"),
    numbers: tuple[Convolutions, ...] = ("float32", "bfloat16"),
    json: Path | None = None,
) -> int:
    """Measure this device, and compare it with its own limits.

    Args:
      size: width and height of the photos, pixels.
      presets: the presets to measure.
      numbers: the types of numbers that the network and the matching multiply. On a CPU bfloat16
        only rounds.
      json: write all figures to this file.
    """
    weights, photos, rates = load_weights(), rendered_photos(*size), device_rates()
    device = jax.devices()[0]
    print(
        f"{device.device_kind} ({device.platform}), {size[0]} x {size[1]}: products "
        f"{', '.join(f'{rate / 1e12:.3g} ({kind})' for kind, rate in rates.products.items())} "
        f"TFLOP/s, memory {rates.bytes / 1e9:.3g} GB/s\n",
        flush=True,
    )
    print(table_head())
    rows: list[Measured] = []
    found: dict[str, Found] = {}
    for name in presets:
        for kind in numbers:
            config = dataclasses.replace(
                preset(name), max_size=max(size), convolutions=kind, products=kind
            )
            more, counts = measure(weights, name, config, photos, rates)
            found.setdefault(name, counts)
            rows += more
            # At once: on an accelerator, the next ones can take minutes to compile.
            print(*map(table_line, more), sep="\n", flush=True)
    if json is not None:
        figures = {
            "device": f"{device.device_kind} ({device.platform})",
            "size": list(size),
            "rates": rates._asdict(),
            "rows": [row._asdict() | {"stages": [s._asdict() for s in row.stages]} for row in rows],
            "found": {name: counts._asdict() for name, counts in found.items()},
        }
        write_json(json, figures)
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
