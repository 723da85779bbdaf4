"""Verified matches of pairs of images, in batches over all devices.

Joined features of the images at hand stay on the devices; pairs are taken tile by tile of the table
of all pairs, so that an image comes back as rarely as that memory allows.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh

from jaxsfm.config import Config, PairShape
from jaxsfm.core.grid import rescale
from jaxsfm.core.sharded import match_batch, pick
from jaxsfm.core.types import JoinedFeatures, PairMatches, Status, Thresholds
from jaxsfm.io.features import FeatureCapacity, ImageFeatures
from jaxsfm.io.pairs import PairResult, make_pair
from jaxsfm.io.pixels import Pixels
from jaxsfm.matching.device_cache import OnDevice, Resident, by_tiles, join
from jaxsfm.matching.execution import (
    SINGLE,
    Execution,
    chosen_devices,
    one_ahead,
    pairs_at_once,
    resident_images,
)

Name = TypeVar("Name")


def match_features(
    features0: ImageFeatures, features1: ImageFeatures, *, config: Config, seed: int = 0
) -> PairResult:
    """Verified matches of two images, in the order given."""
    both = {0: features0, 1: features1}
    capacities = {side: features.capacity for side, features in both.items()}
    return next(_matched(both.__getitem__, capacities, [(0, 1)], config, seed, SINGLE))


def matched(
    load: Callable[[str], ImageFeatures],
    capacities: Mapping[str, FeatureCapacity],
    pairs: Iterable[tuple[str, str]],
    *,
    config: Config,
    seed: int = 0,
    execution: Execution | None = None,
) -> Iterator[PairResult]:
    """Verified matches of pairs (the lesser name first), as batches are done.

    A pair's result depends on the two images, the config and the seed; not on the other pairs, nor
    on their order, nor on how many devices there are. With several pairs side by side on a device
    products may round differently in the last place (`jaxsfm.matching.execution`).

    Args:
      load: an image's features by its name; asked again when they have left the device.
      capacities: the feature capacity of every image.
    """
    named = [make_pair(a, b) for a, b in pairs]
    return _matched(load, capacities, named, config, seed, execution or Execution())


def thresholds(config: Config) -> Thresholds:
    """The config's traced half."""
    return Thresholds(
        np.float32(config.threshold_px),  # pyright: ignore[reportArgumentType]
        np.int32(config.min_inliers),  # pyright: ignore[reportArgumentType]
        np.float32(config.confidence),  # pyright: ignore[reportArgumentType]
    )


class _Program(NamedTuple):
    """What a compiled program of pairs is made for."""

    room: int
    """Coarse capacity of both sides."""
    shape: PairShape


def _program(capacity0: FeatureCapacity, capacity1: FeatureCapacity, config: Config) -> _Program:
    shape, widest = config.pair, max(capacity0.columns, capacity1.columns)
    if shape.consensus and widest > shape.coarse_columns:
        shape = dataclasses.replace(shape, coarse_columns=-(-widest // 64) * 64)
    return _Program(max(capacity0.num_coarse, capacity1.num_coarse), shape)


class _Started(NamedTuple):
    """A batch on the devices, and the hosts' part of its images."""

    found: PairMatches
    sides: list[tuple[ImageFeatures, ImageFeatures]]


def _matched(
    load: Callable[[Name], ImageFeatures],
    capacities: Mapping[Name, FeatureCapacity],
    pairs: Sequence[tuple[Name, Name]],
    config: Config,
    seed: int,
    execution: Execution,
) -> Iterator[PairResult]:
    mesh, root = chosen_devices(execution), jax.random.key(seed)
    programs: dict[_Program, list[tuple[Name, Name]]] = {}
    for a, b in pairs:
        programs.setdefault(_program(capacities[a], capacities[b], config), []).append((a, b))

    def batches() -> Iterator[_Batch]:
        for program, some in programs.items():
            side_by_side = pairs_at_once(execution, mesh, program.room, len(some), config=config)
            most = resident_images(execution, mesh, program.room, config=config)
            ordered = by_tiles(some, max(1, most // 2))

            def joined(name: Name, room: int = program.room) -> OnDevice:
                return join(load(name), room, mesh)

            resident, todo = Resident(joined, ordered, most), iter(ordered)
            while batch := list(itertools.islice(todo, side_by_side * mesh.size)):
                images = [(resident.take(a), resident.take(b)) for a, b in batch]
                yield _Batch(program, side_by_side, images)

    def start(batch: _Batch) -> _Started:
        missing = batch.side_by_side * mesh.size - len(batch.images)
        filled = batch.images + batch.images[-1:] * missing
        found = match_batch(
            root,
            _identities(filled, mesh),
            tuple(_columns(filled, mesh)),
            thresholds(config),
            mesh=mesh,
            shape=batch.program.shape,
        )
        return _Started(found, [(a.features, b.features) for a, b in batch.images])

    return one_ahead(batches(), start, _results)


class _Batch(NamedTuple):
    """Pairs of one program, loaded, and how many of them a device computes side by side."""

    program: _Program
    side_by_side: int
    images: list[tuple[OnDevice, OnDevice]]


def _identities(images: Sequence[tuple[OnDevice, OnDevice]], mesh: Mesh) -> np.ndarray:
    ids = [[each.features.image.identity for each in sides] for sides in images]
    return np.asarray(ids, np.uint32).reshape(mesh.size, -1, 2)


def _columns(
    images: Sequence[tuple[OnDevice, OnDevice]], mesh: Mesh
) -> Iterator[tuple[JoinedFeatures, JoinedFeatures]]:
    """For each place in a device's batch both sides, over the devices."""
    each = len(images) // mesh.size
    for k in range(each):
        left, right = zip(*images[k::each], strict=True)
        yield (
            pick([image.joined for image in left], mesh=mesh),
            pick([image.joined for image in right], mesh=mesh),
        )


def _results(started: _Started) -> Iterator[PairResult]:
    host = jax.device_get(started.found)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), host)
    for k, sides in enumerate(started.sides):
        yield to_original_pixels(jax.tree.map(lambda x, k=k: x[k], flat), *sides)


def to_original_pixels(
    found: PairMatches, features0: ImageFeatures, features1: ImageFeatures
) -> PairResult:
    """From the program's padded output to lists in original pixels."""
    keep = np.asarray(found.plane) >= 0
    cells = np.asarray(found.cells)[keep]

    def keypoints(features: ImageFeatures, side: int) -> np.ndarray:
        xy = np.asarray(features.dense.keypoints, np.float64)[cells[:, side]]
        return np.asarray(rescale(xy, np.asarray(features.scale))).astype(np.float32)

    # In float64 on the host: 1600 px coordinates squared leave float32 no digits to invert with.
    present = np.asarray(found.num_inliers) > 0
    to0, to1 = (Pixels(each.scale).matrix() for each in (features0, features1))
    h = to1 @ np.asarray(found.homographies, np.float64)[present] @ np.linalg.inv(to0)
    norms = np.linalg.norm(h, axis=(1, 2), keepdims=True)
    return PairResult(
        pair=(features0.image.name, features1.image.name),
        cells=cells,
        keypoints0=keypoints(features0, 0),
        keypoints1=keypoints(features1, 1),
        plane=np.asarray(found.plane)[keep],
        homographies=h / norms,
        num_tentative=int(found.num_tentative),
        num_dropped=int(found.num_dropped),
        status=Status(int(found.status)),
    )
