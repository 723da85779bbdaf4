"""Speed of features and pairs on whatever device JAX has, and what the device could do at most.

    python -m jaxsfm.bench.accelerator --json accelerator.json

Two views of a rendered room are the photos. Features and pairs run in the batches that a run takes
on this device. Their rates are compared with the device's own rates of matrix products and of
memory, which are measured in the same run, and with the counts of `jaxsfm.bench.on_paper`. On an
accelerator the results are compared with those of the CPU.
"""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.sharding import Mesh

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.on_paper import DEVICES, Found, Stage, image_work, pair_work, seconds
from jaxsfm.bench.speed.machine import MATMUL_FLOP, STREAM_ENTRIES, add_one, matrix_product
from jaxsfm.bench.speed.timing import median
from jaxsfm.bench.speed.timing import seconds as timed
from jaxsfm.bench.synthetic import arc, render, room
from jaxsfm.config import Config, preset
from jaxsfm.core.pair import pair_key
from jaxsfm.core.ransac import peel_planes
from jaxsfm.core.sharded import device_mesh, extract_batch, join_everywhere, match_batch
from jaxsfm.core.types import PairMatches
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.io.weights import Weights, load_weights
from jaxsfm.matching.execution import Execution, images_at_once, pairs_at_once
from jaxsfm.matching.extraction import extraction_settings
from jaxsfm.matching.pair_matching import thresholds

ENOUGH = 64
"""Images, or pairs, of which batches are made: as many as a run has at least."""


class Rates(NamedTuple):
    """What a device does at most, measured."""

    products: float
    """Operations a second in float32 products at full precision."""
    bytes: float
    """Bytes a second that are read and written."""


class Measured(NamedTuple):
    """Images or pairs of one preset on one device."""

    what: str
    preset: str
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


class Photos(NamedTuple):
    """Two padded photos, as a run gives them to the device."""

    images: np.ndarray
    """uint8 (2, rows, columns, 3)."""
    size: np.ndarray
    """Valid (rows, columns)."""
    num_coarse: int


def rendered_photos(width: int, height: int) -> Photos:
    """Two neighbouring views of the rendered room."""
    views = [render(room(), arc(7)[k], (width, height)) for k in (2, 3)]
    rows, columns = padded_size((width, height))
    images = np.zeros((2, rows, columns, 3), np.uint8)
    images[:, :height, :width] = views
    size = np.asarray([height, width], np.int32)
    return Photos(images, size, feature_capacity((width, height)).num_coarse)


def device_rates() -> Rates:
    """Matrix products and memory of the default device."""
    a = jnp.zeros(STREAM_ENTRIES, jnp.float32)
    product, stream = timed(matrix_product(), lambda: add_one(a))
    return Rates(MATMUL_FLOP / median(product), 2 * a.nbytes / median(stream))


class Programs(NamedTuple):
    """The programs of one preset on one device, ready to be called."""

    extract: Callable[[], object]
    match: Callable[[], object]
    images: int
    pairs: int
    bytes_per_image: float
    bytes_per_pair: float
    keypoints: np.ndarray
    """Of both photos, (2, cells, 2)."""
    matches: PairMatches
    """Of the first pair, on the host."""
    found: Found


def _program_bytes(compiled: jax.stages.Compiled) -> float:
    memory = compiled.memory_analysis()
    return float(memory.temp_size_in_bytes + memory.output_size_in_bytes) if memory else 0.0


def _programs(weights: Weights, config: Config, photos: Photos, mesh: Mesh) -> Programs:
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
    joined = [join_everywhere(jax.tree.map(lambda x: x[0], dense), mesh=mesh) for dense in both]
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


def measure(
    weights: Weights, name: str, config: Config, photos: Photos, rates: Rates
) -> tuple[list[Measured], Found]:
    """Images and pairs of one preset on the first device, and what the pair's work depends on."""
    first = jax.devices()[0]
    programs = _programs(weights, config, photos, device_mesh([first]))
    same: list[float | None] = [None, None]
    if first.platform != "cpu":
        cpu = _programs(weights, config, photos, device_mesh(jax.devices("cpu")[:1]))
        same = list(agreement(programs, cpu))
    extraction, matching = timed(programs.extract, programs.match)
    height, width = map(int, photos.size)
    rows = []
    for what, times, at_once, used, stages, equal in (
        ("images", extraction, programs.images, programs.bytes_per_image,
         image_work(width, height, config), same[0]),
        ("pairs", matching, programs.pairs, programs.bytes_per_pair,
         pair_work(width, height, config, programs.found), same[1]),
    ):  # fmt: skip
        each = median(times) / at_once
        products = sum(stage.products for stage in stages) / each / rates.products
        memory = sum(stage.bytes for stage in stages) / each / rates.bytes
        rows.append(
            Measured(what, name, at_once, 1 / each, products, memory, used / 1e6, equal, stages)
        )
    return rows, programs.found


def agreement(ours: Programs, cpu: Programs) -> tuple[float, float]:
    """Shares of the CPU's keypoints and matches that the device gives as well."""
    keypoints = float((ours.keypoints == cpu.keypoints).all(axis=2).mean())

    same, expected = (
        {(int(a), int(b)) for a, b in found.cells[found.plane >= 0]}
        for found in (ours.matches, cpu.matches)
    )
    return keypoints, len(expected & same) / max(len(expected), 1)


def table_lines(rows: list[Measured], found: dict[str, Found], size: tuple[int, int]) -> list[str]:
    """The measured figures, and those on paper, as two tables in Markdown."""
    heads = ("preset", "what", "at once", "a second", "products", "memory", "MB each", "as the CPU")
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        same = "" if row.same_as_cpu is None else f"{row.same_as_cpu:.2%}"
        lines.append(
            f"| {row.preset} | {row.what} | {row.at_once} | {_digits(row.per_second)} | "
            f"{row.products:.0%} | {row.memory:.0%} | {row.megabytes:.0f} | {same} |"
        )
    lines += ["", "| on paper, a second | " + " | ".join(d.name for d in DEVICES) + " |"]
    lines.append("|" + "---|" * (len(DEVICES) + 1))
    for name, counts in found.items():
        config = preset(name)
        for what, stages, batch in (
            ("images", image_work(*size, config), 1),
            ("pairs", pair_work(*size, config, counts), 1),
            ("pairs, 64 at once", pair_work(*size, config, counts), 64),
        ):
            for half, kind in ((False, "float32"), (True, "half products")):
                cells = (1 / seconds(stages, d, batch=batch, half=half) for d in DEVICES)
                lines.append(f"| {name}, {what}, {kind} | {' | '.join(map(_digits, cells))} |")
    return lines


def _digits(x: float) -> str:
    """Three digits, or all of a larger number."""
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def main(
    size: tuple[int, int] = (1600, 1200),
    presets: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PRESET")] = ("paper", "default"),
    json: Path | None = None,
) -> int:
    """Measure this device, compare it with its own limits, and print what others could do.

    Args:
      size: width and height of the photos, pixels.
      presets: the presets to measure.
      json: write all figures to this file.
    """
    weights, photos, rates = load_weights(), rendered_photos(*size), device_rates()
    device = jax.devices()[0]
    print(
        f"{device.device_kind} ({device.platform}), {size[0]} x {size[1]}: products "
        f"{rates.products / 1e12:.3g} TFLOP/s, memory {rates.bytes / 1e9:.3g} GB/s\n",
        flush=True,
    )
    rows: list[Measured] = []
    found: dict[str, Found] = {}
    for name in presets:
        config = dataclasses.replace(preset(name), max_size=max(size))
        more, found[name] = measure(weights, name, config, photos, rates)
        rows += more
    print("\n".join(table_lines(rows, found, size)))
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
