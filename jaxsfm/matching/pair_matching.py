"""Verified matches of pairs of images, in batches over all devices.

The devices keep the joined features of some images. Pairs are matched tile by tile of the table of
all pairs, so that an image is loaded as rarely as that memory allows.
"""

import dataclasses
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Generic, NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxsfm.config import Config, PairShape
from jaxsfm.core.pair_shape import Products
from jaxsfm.core.sharded import join_everywhere, match_batch, pick
from jaxsfm.core.types import (
    DenseFeatures,
    JoinedFeatures,
    OctavePart,
    PairMatches,
    Status,
    Thresholds,
)
from jaxsfm.io.features import FeatureCapacity, ImageFeatures, pad_features
from jaxsfm.io.orientation import stored_points
from jaxsfm.io.pairs import Name, PairResult, make_pair
from jaxsfm.io.photos import Pixels
from jaxsfm.io.traced_programs import Traced
from jaxsfm.matching.execution import (
    ONE_AT_A_TIME,
    Execution,
    cached_images,
    overlap_batches,
    pairs_at_once,
    select_devices,
)

Loaded = TypeVar("Loaded")

_join = Traced(join_everywhere, DenseFeatures, JoinedFeatures, OctavePart)
_match = Traced(match_batch, JoinedFeatures, OctavePart, Thresholds, PairMatches)


def match_features(
    features0: ImageFeatures, features1: ImageFeatures, *, config: Config, seed: int = 0
) -> PairResult:
    """Verified matches of two images; `features0` is the first image of the result."""
    both = {0: features0, 1: features1}
    capacities = {side: features.capacity for side, features in both.items()}
    (result,) = match_pairs(
        both.__getitem__, capacities, [(0, 1)], config=config, seed=seed, execution=ONE_AT_A_TIME
    )
    return result


def match_pairs(
    load: Callable[[Name], ImageFeatures],
    capacities: Mapping[Name, FeatureCapacity],
    pairs: Iterable[tuple[Name, Name]],
    *,
    config: Config,
    seed: int = 0,
    execution: Execution | None = None,
) -> Iterator[PairResult]:
    """Yield the verified matches of pairs, batch by batch; in each pair the lesser name is first.

    A pair's result depends on the two images, the config and the seed. It does not depend on the
    other pairs, on their order, or on the number of devices. With several pairs side by side on a
    device, products may round differently in the last place (`jaxsfm.matching.execution`).

    Args:
      load: loads an image's features by its name; it is called again if they have left the device.
      capacities: the feature capacity of every image, by its name.
    """
    chosen = execution or Execution()
    mesh, root = select_devices(chosen), jax.random.key(seed)
    programs: dict[_Program, list[tuple[Name, Name]]] = {}
    for a, b in (make_pair(*pair) for pair in pairs):
        programs.setdefault(_program(capacities[a], capacities[b], config), []).append((a, b))

    def batches() -> Iterator[_Batch]:
        for program, some in programs.items():
            num_coarse = program.num_coarse
            side_by_side = pairs_at_once(chosen, mesh, num_coarse, len(some), config=config)
            most = cached_images(chosen, mesh, num_coarse, config=config)
            ordered = tile_order(some, max(1, most // 2))

            def on_devices(name: Name, num_coarse: int = num_coarse) -> DeviceFeatures:
                return put_on_devices(load(name), num_coarse, mesh, products=config.products)

            cache, todo = ImageCache(on_devices, ordered, most), iter(ordered)
            while batch := list(itertools.islice(todo, side_by_side * mesh.size)):
                images = [(cache.take(a), cache.take(b)) for a, b in batch]
                yield _Batch(program, side_by_side, images)

    def start(batch: _Batch) -> _Started:
        missing = batch.side_by_side * mesh.size - len(batch.images)
        filled = batch.images + batch.images[-1:] * missing
        found = _match(
            root,
            _identities(filled, mesh),
            tuple(_columns(filled, mesh)),
            thresholds(config),
            mesh=mesh,
            shape=batch.program.shape,
        )
        return _Started(found, [(a.features, b.features) for a, b in batch.images])

    return overlap_batches(batches(), start, _results)


def thresholds(config: Config) -> Thresholds:
    """The numbers of a config that a compiled program takes as arguments."""
    return Thresholds(
        np.float32(config.threshold_px),  # pyright: ignore[reportArgumentType]
        np.int32(config.min_inliers),  # pyright: ignore[reportArgumentType]
        np.float32(config.confidence),  # pyright: ignore[reportArgumentType]
    )


class DeviceFeatures(NamedTuple):
    """One image's features between batches: descriptors on every device, the rest on the host."""

    features: ImageFeatures
    """The features without descriptors."""
    joined: JoinedFeatures


def put_on_devices(
    features: ImageFeatures, num_coarse: int, mesh: Mesh, *, products: Products
) -> DeviceFeatures:
    """Join an image's octaves on all devices of a mesh, padded to `num_coarse` coarse cells."""
    bare = features.dense._replace(coarse=(), fine=())
    joined = _join(pad_features(features.dense, num_coarse), mesh=mesh, products=products)
    return DeviceFeatures(features._replace(dense=bare), joined)


class _Program(NamedTuple):
    """What a program for pairs is compiled for."""

    num_coarse: int
    """Coarse capacity of both images."""
    shape: PairShape


def pair_shape(config: Config, *capacities: FeatureCapacity) -> PairShape:
    """The settings of the pair program for images of these capacities."""
    shape, widest = config.pair, max(capacity.columns for capacity in capacities)
    if shape.consensus and widest > shape.coarse_columns:
        shape = dataclasses.replace(shape, coarse_columns=-(-widest // 64) * 64)
    return shape


def _program(capacity0: FeatureCapacity, capacity1: FeatureCapacity, config: Config) -> _Program:
    num_coarse = max(capacity0.num_coarse, capacity1.num_coarse)
    return _Program(num_coarse, pair_shape(config, capacity0, capacity1))


class _Started(NamedTuple):
    """A batch that runs on the devices, and the parts of its images that are on the host."""

    matches: PairMatches
    images: list[tuple[ImageFeatures, ImageFeatures]]


class _Batch(NamedTuple):
    """Loaded pairs of one program, and how many of them a device computes side by side."""

    program: _Program
    side_by_side: int
    images: list[tuple[DeviceFeatures, DeviceFeatures]]


def _identities(images: Sequence[tuple[DeviceFeatures, DeviceFeatures]], mesh: Mesh) -> np.ndarray:
    ids = [[each.features.image.identity for each in sides] for sides in images]
    return np.asarray(ids, np.uint32).reshape(mesh.size, -1, 2)


def _columns(
    images: Sequence[tuple[DeviceFeatures, DeviceFeatures]], mesh: Mesh
) -> Iterator[tuple[JoinedFeatures, JoinedFeatures]]:
    """For each place in a device's batch, the first and the second images of all devices."""
    each = len(images) // mesh.size
    for k in range(each):
        left, right = zip(*images[k::each], strict=True)
        yield (
            pick([image.joined for image in left], mesh=mesh),
            pick([image.joined for image in right], mesh=mesh),
        )


def _results(started: _Started) -> Iterator[PairResult]:
    host = jax.device_get(started.matches)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), host)
    for k, sides in enumerate(started.images):
        yield to_original_pixels(jax.tree.map(lambda x, k=k: x[k], flat), *sides)


def to_original_pixels(
    found: PairMatches, features0: ImageFeatures, features1: ImageFeatures
) -> PairResult:
    """Convert a program's padded output to the pair's matches, in pixels of the stored photos."""
    keep = np.asarray(found.plane) >= 0
    cells = np.asarray(found.cells)[keep]

    def keypoints(features: ImageFeatures, side: int) -> np.ndarray:
        xy = np.asarray(features.dense.keypoints, np.float64)[cells[:, side]]
        image, upright = features.image, Pixels(features.scale).to_original(xy)
        return stored_points(upright, image.size, image.orientation).astype(np.float32)

    # The conversion is done in float64 on the host: squares of coordinates up to 1600 px leave
    # float32 too few digits for an inverse.
    present = np.asarray(found.num_inliers) > 0
    to0, to1 = (each.to_stored() for each in (features0, features1))
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


def tile_order(pairs: Sequence[tuple[Name, Name]], side: int) -> list[tuple[Name, Name]]:
    """Order pairs so that a cache of 2 `side` images loads every image as rarely as possible.

    The images are ordered by reverse Cuthill-McKee, which puts paired images near each other
    whatever their names are, and cut into blocks of `side`. All pairs between two blocks, a tile
    of the table of pairs, follow each other. If all pairs are to be matched, any order of the
    images is as good.
    """
    if not pairs:
        return []
    number = {name: k for k, name in enumerate(dict.fromkeys(n for p in pairs for n in p))}
    ends = np.asarray([[number[a], number[b]] for a, b in pairs])
    graph = coo_array((np.ones(len(ends)), ends.T), shape=2 * (len(number),)).tocsr()
    block = np.empty(len(number), int)
    block[reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True)] = np.arange(len(number))
    block //= side
    return sorted(pairs, key=lambda pair: sorted(block[number[name]] for name in pair))


class ImageCache(Generic[Name, Loaded]):
    """What was loaded of images, while a list of pairs (or of blocks of pairs) is worked off.

    The list is known in advance. So a full cache drops the image whose next use is furthest away,
    which is the best choice there is (Belady 1966), and an image after its last use.
    """

    def __init__(
        self, load: Callable[[Name], Loaded], pairs: Sequence[Sequence[Name]], most: int
    ) -> None:
        """`take` will ask for the names of each pair or block in turn; at most `most` are held."""
        self._load, self._most = load, most
        self._images: dict[Name, Loaded] = {}
        self._uses: dict[Name, deque[int]] = {}
        for k, pair in enumerate(pairs):
            for name in pair:
                self._uses.setdefault(name, deque()).append(k)

    def __len__(self) -> int:
        return len(self._images)

    def take(self, name: Name) -> Loaded:
        """An image for its next pair."""
        if name not in self._images:
            while len(self._images) >= self._most:
                del self._images[max(self._images, key=lambda other: self._uses[other][0])]
            self._images[name] = self._load(name)
        image = self._images[name]
        self._uses[name].popleft()
        if not self._uses[name]:
            del self._images[name]
        return image
