"""Engines extract features and match pairs: in this process, or with workers on Ray.

A worker on Ray runs the same code as this process (`jaxsfm.matching.extraction`,
`jaxsfm.matching.pair_matching`) on its own devices, so its results are the same. Photos travel as
the bytes of their files: then no shared file system is needed, and files are smaller than features.
Features travel through the object store of Ray.
"""

import dataclasses
import functools
import itertools
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
from jax.sharding import NamedSharding, PartitionSpec

from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.features import FeatureCapacity, ImageFeatures
from jaxsfm.io.images import ImageError, ImageFile, image_bytes, working_size
from jaxsfm.io.masks import mask_path
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.weights import Weights
from jaxsfm.matching import extraction, pair_matching
from jaxsfm.matching.execution import Execution, select_devices
from jaxsfm.matching.pair_matching import ImageCache, tile_order
from jaxsfm.matching.ray_cluster import import_ray
from jaxsfm.matching.ray_workers import Task, worker_pool
from jaxsfm.options import EngineChoice

TASK_IMAGES = 8
"""Photos in a task at most; an accelerator takes so many side by side."""
TILE = 8
"""A task of pairs touches at most twice as many images, 400 MB at 1536 x 1024."""
CACHED_IMAGES = 4 * TILE
"""Images whose features wait in the object store for tasks to come, beside those of tasks that
workers have."""
TASKS_EACH = 4
"""A worker gets at least so many tasks where there is little to do, so that all workers end at
about the same time."""


class LocalEngine:
    """This process computes, with all of its devices."""

    starts_workers = False
    """Whether every call starts workers first, which takes seconds: then few calls with many items
    are better than many calls."""
    extract_images = staticmethod(extraction.extract_images)
    match_pairs = staticmethod(pair_matching.match_pairs)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RayEngine:
    """Workers on a Ray cluster compute."""

    address: str | None = None
    """HOST:PORT of the cluster; None: see `jaxsfm.matching.ray_cluster.connect`."""
    workers: int | None = None
    """Number of workers; None: one on each GPU, or, if there are no GPUs, one for as many CPUs as
    this process would use."""

    starts_workers = True

    def extract_images(
        self,
        weights: Weights,
        images: Iterable[ImageFile],
        *,
        config: Config,
        execution: Execution | None = None,
    ) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
        """As `jaxsfm.matching.extraction.extract_images`, in any order; UserError also for Ray."""
        ordered = sorted(
            images,
            key=lambda image: working_size(image.upright_size, config.max_size, config.enlarge),
        )
        if not ordered:
            return
        work = ExtractionWork(weights, config, execution or Execution())
        with worker_pool(work, address=self.address, workers=self.workers) as pool:
            size = _task_size(len(ordered), len(pool), TASK_IMAGES)
            tasks = (
                Task(some, {image.name: pool.put(_bytes(image)) for image in some})
                for some in (ordered[k : k + size] for k in range(0, len(ordered), size))
            )
            yield from pool.results(tasks)

    def match_pairs(
        self,
        load: Callable[[str], ImageFeatures],
        capacities: Mapping[str, FeatureCapacity],
        pairs: Iterable[tuple[str, str]],
        *,
        config: Config,
        seed: int = 0,
        execution: Execution | None = None,
    ) -> Iterator[PairResult]:
        """As `jaxsfm.matching.pair_matching.match_pairs`, in any order; UserError also for Ray."""
        named = [make_pair(a, b) for a, b in pairs]
        if not named:
            return
        work = MatchingWork(dict(capacities), config, seed, execution or Execution())
        with worker_pool(work, address=self.address, workers=self.workers) as pool:
            blocks = pair_blocks(named, _task_size(len(named), len(pool), TILE * TILE))
            touched = [list(dict.fromkeys(itertools.chain(*block))) for block in blocks]
            cache = ImageCache(lambda name: pool.put(load(name)), touched, CACHED_IMAGES)
            tasks = (
                Task(block, {name: cache.take(name) for name in names})
                for block, names in zip(blocks, touched, strict=True)
            )
            for _, result in pool.results(tasks):
                yield result


Engine: TypeAlias = LocalEngine | RayEngine
"""Extracts and matches. Results come in any order, and never depend on the engine."""


def chosen_engine(choice: EngineChoice) -> Engine:
    """The engine that --engine, --workers and --ray-address choose; UserError if they cannot."""
    if choice.workers is not None and choice.workers < 1:
        raise UserError(f"--workers must be at least 1; got {choice.workers}")
    if choice.engine == "local":
        if choice.workers is not None or choice.ray_address is not None:
            given = "--ray-address" if choice.workers is None else "--workers"
            raise UserError(f"{given} is for --engine ray")
        return LocalEngine()
    import_ray()  # a missing package is reported before the work
    return RayEngine(address=choice.ray_address, workers=choice.workers)


class PhotoBytes(NamedTuple):
    """The bytes of a photo's files."""

    photo: bytes
    mask: bytes | None


def _bytes(image: ImageFile) -> PhotoBytes | ImageError:
    try:
        return PhotoBytes(image_bytes(image), image.mask and image.mask.path.read_bytes())
    except ImageError as error:
        return error
    except OSError as error:
        assert image.mask is not None
        return ImageError(f"{image.mask.path}: cannot be read ({error.strerror})")


def _task_size(count: int, workers: int, most: int) -> int:
    """How many of `count` items make a task."""
    return min(most, max(1, -(-count // (TASKS_EACH * workers))))


def pair_blocks(pairs: Sequence[Pair], size: int) -> list[list[Pair]]:
    """Cut pairs into blocks of at most `size` pairs between at most 2 `TILE` images.

    Blocks that follow each other share images.
    """
    blocks: list[list[Pair]] = []
    touched: set[str] = set()
    for pair in tile_order(pairs, TILE):
        touched.update(pair)
        if not blocks or len(blocks[-1]) == size or len(touched) > 2 * TILE:
            blocks.append([])
            touched = set(pair)
        blocks[-1].append(pair)
    return blocks


@dataclasses.dataclass(frozen=True)
class ExtractionWork:
    """What a worker does with photos (`jaxsfm.matching.ray_workers.Work`)."""

    weights: Weights
    config: Config
    execution: Execution

    @functools.cached_property
    def _on_devices(self) -> Weights:
        everywhere = NamedSharding(select_devices(self.execution), PartitionSpec())
        params = jax.device_put(self.weights.params, everywhere)
        return dataclasses.replace(self.weights, params=params)

    def __call__(
        self, images: Sequence[ImageFile], files: Mapping[str, PhotoBytes | ImageError]
    ) -> Iterator[tuple[ImageFile, ImageFeatures | ImageError]]:
        """Extract images, whose files are written to a temporary folder of this machine."""
        theirs = {image.name: image for image in images}
        with tempfile.TemporaryDirectory(prefix="jaxsfm-") as folder:
            here = []
            for k, image in enumerate(images):
                data = files[image.name]
                if isinstance(data, ImageError):
                    yield image, data
                    continue
                path = Path(folder) / f"{k}{image.path.suffix}"
                path.write_bytes(data.photo)
                mask = image.mask
                if mask is not None and data.mask is not None:
                    mask = dataclasses.replace(mask, path=mask_path(Path(folder), str(k)))
                    mask.path.write_bytes(data.mask)
                here.append(dataclasses.replace(image, path=path, mask=mask))
            stream = extraction.extract_images(
                self._on_devices, here, config=self.config, execution=self.execution
            )
            for image, found in stream:
                own = theirs[image.name]
                yield own, found if isinstance(found, ImageError) else found._replace(image=own)


@dataclasses.dataclass(frozen=True)
class MatchingWork:
    """What a worker does with pairs (`jaxsfm.matching.ray_workers.Work`)."""

    capacities: Mapping[str, FeatureCapacity]
    config: Config
    seed: int
    execution: Execution

    def __call__(
        self, pairs: Sequence[Pair], features: Mapping[str, ImageFeatures]
    ) -> Iterator[tuple[Pair, PairResult]]:
        """Match pairs."""
        stream = pair_matching.match_pairs(
            features.__getitem__,
            self.capacities,
            pairs,
            config=self.config,
            seed=self.seed,
            execution=self.execution,
        )
        for result in stream:
            yield result.pair, result
