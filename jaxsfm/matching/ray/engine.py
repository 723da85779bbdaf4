"""Extraction and matching by workers on Ray: what is sent to them, and what they do with it.

A worker runs the same code as this process (`jaxsfm.matching.extraction.extracted`,
`jaxsfm.matching.pair_matching.matched`) on its own devices, so its results are the same. Photos
travel as the bytes of their files: no shared file system is needed, and files are smaller than
features. Features travel through the object store of Ray.
"""

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import NamedSharding, PartitionSpec

from jaxsfm.config import Config
from jaxsfm.io.features import FeatureCapacity, ImageFeatures
from jaxsfm.io.images import ImageError, ImageFile, image_bytes, working_size
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.weights import Weights
from jaxsfm.matching.device_cache import Resident, by_tiles
from jaxsfm.matching.execution import Execution, chosen_devices
from jaxsfm.matching.extraction import extracted
from jaxsfm.matching.pair_matching import matched
from jaxsfm.matching.ray.workers import Piece, crew

PIECE_IMAGES = 8
"""Photos sent to a worker together at most; an accelerator takes so many side by side."""
TILE = 8
"""A block of pairs touches at most 2 x so many images, 400 MB at 1536 x 1024."""
HELD_IMAGES = 4 * TILE
"""Features held in the object store for blocks to come, beside those of blocks with workers."""
PIECES_EACH = 4
"""A worker gets at least so many pieces where there is little to do, so that all end together."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RayEngine:
    """See `jaxsfm.matching.engines.Engine`."""

    address: str | None = None
    """Of the cluster; None: one that runs here, else a local one for the time being."""
    workers: int | None = None
    """None: one on each GPU; without GPUs one for as many CPUs as this process would use."""

    def extracted(
        self,
        weights: Weights,
        images: Iterable[ImageFile],
        *,
        config: Config,
        execution: Execution | None = None,
    ) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
        """`jaxsfm.matching.extraction.extracted`, in any order.

        Raises:
          UserError: also where Ray cannot be used, or loses workers again and again.
        """
        ordered = sorted(
            images, key=lambda image: working_size(image.size, config.max_size, config.enlarge)
        )
        if not ordered:
            return
        work = Extracting(weights, config, execution or Execution())
        with crew(work, address=self.address, workers=self.workers) as workers:
            pieces = (
                Piece(some, {image.name: workers.put(_bytes(image)) for image in some})
                for some in _cut(ordered, _size(len(ordered), len(workers), PIECE_IMAGES))
            )
            yield from workers.results(pieces)

    def matched(
        self,
        load: Callable[[str], ImageFeatures],
        capacities: Mapping[str, FeatureCapacity],
        pairs: Iterable[tuple[str, str]],
        *,
        config: Config,
        seed: int = 0,
        execution: Execution | None = None,
    ) -> Iterator[PairResult]:
        """`jaxsfm.matching.pair_matching.matched`, in any order.

        Raises:
          UserError: also where Ray cannot be used, or loses workers again and again.
        """
        named = [make_pair(a, b) for a, b in pairs]
        if not named:
            return
        work = Matching(dict(capacities), config, seed, execution or Execution())
        with crew(work, address=self.address, workers=self.workers) as workers:
            blocks = cut_pairs(named, _size(len(named), len(workers), TILE * TILE))
            touched = [_images(block) for block in blocks]
            held = Resident(lambda name: workers.put(load(name)), touched, HELD_IMAGES)
            pieces = (
                Piece(block, {name: held.take(name) for name in names})
                for block, names in zip(blocks, touched, strict=True)
            )
            for _, result in workers.results(pieces):
                yield result


def _bytes(image: ImageFile) -> bytes | ImageError:
    try:
        return image_bytes(image)
    except ImageError as error:
        return error


def _size(count: int, workers: int, most: int) -> int:
    """Of pieces, of `count` items together."""
    return min(most, max(1, -(-count // (PIECES_EACH * workers))))


def _cut(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    return (items[k : k + size] for k in range(0, len(items), size))


def _images(pairs: Iterable[Pair]) -> list[str]:
    return list(dict.fromkeys(name for pair in pairs for name in pair))


def cut_pairs(pairs: Sequence[Pair], size: int) -> list[list[Pair]]:
    """Blocks of at most `size` pairs between at most 2 `TILE` images; neighbours share images."""
    blocks: list[list[Pair]] = []
    touched: set[str] = set()
    for pair in by_tiles(pairs, TILE):
        touched.update(pair)
        if not blocks or len(blocks[-1]) == size or len(touched) > 2 * TILE:
            blocks.append([])
            touched = set(pair)
        blocks[-1].append(pair)
    return blocks


@dataclasses.dataclass(frozen=True)
class Extracting:
    """What a worker does with photos."""

    weights: Weights
    config: Config
    execution: Execution

    @functools.cached_property
    def _on_devices(self) -> Weights:
        everywhere = NamedSharding(chosen_devices(self.execution), PartitionSpec())
        params = jax.device_put(self.weights.params, everywhere)
        return dataclasses.replace(self.weights, params=params)

    def __call__(
        self, images: Sequence[ImageFile], files: Mapping[str, bytes | ImageError]
    ) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
        """Features of images, whose files are written where this machine has room for them."""
        theirs = {image.name: image for image in images}
        with tempfile.TemporaryDirectory(prefix="jaxsfm-") as folder:
            here = []
            for k, image in enumerate(images):
                data = files[image.name]
                if isinstance(data, ImageError):
                    yield image, data
                    continue
                path = Path(folder) / f"{k}{image.path.suffix}"
                path.write_bytes(data)
                here.append(dataclasses.replace(image, path=path))
            stream = extracted(self._on_devices, here, config=self.config, execution=self.execution)
            for image, found in stream:
                own = theirs[image.name]
                yield own, found if isinstance(found, ImageError) else found._replace(image=own)


@dataclasses.dataclass(frozen=True)
class Matching:
    """What a worker does with pairs."""

    capacities: Mapping[str, FeatureCapacity]
    config: Config
    seed: int
    execution: Execution

    def __call__(
        self, pairs: Sequence[Pair], features: Mapping[str, ImageFeatures]
    ) -> Iterator[tuple[Pair, PairResult]]:
        """Verified matches of pairs."""
        stream = matched(
            features.__getitem__,
            self.capacities,
            pairs,
            config=self.config,
            seed=self.seed,
            execution=self.execution,
        )
        for result in stream:
            yield result.pair, result
