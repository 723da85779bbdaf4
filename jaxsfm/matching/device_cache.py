"""Images at hand: joined features that stay on the devices from pair to pair."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jax.sharding import Mesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxsfm.core.sharded import join_everywhere
from jaxsfm.core.types import JoinedFeatures
from jaxsfm.io.features import ImageFeatures, pad_features

Name = TypeVar("Name")


def by_tiles(pairs: Sequence[tuple[Name, Name]], side: int) -> list[tuple[Name, Name]]:
    """Pairs in an order in which 2 `side` images at a time go far: those between two blocks of
    `side` images after each other, where images that are paired are near each other in the blocks'
    order (reverse Cuthill-McKee), whatever their names. Of all pairs any order is as good."""
    if not pairs:
        return []
    number = {name: k for k, name in enumerate(dict.fromkeys(n for p in pairs for n in p))}
    ends = np.asarray([[number[a], number[b]] for a, b in pairs])
    graph = coo_array((np.ones(len(ends)), ends.T), shape=2 * (len(number),)).tocsr()
    block = np.empty(len(number), int)
    block[reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True)] = np.arange(len(number))
    block //= side
    return sorted(pairs, key=lambda pair: sorted(block[number[name]] for name in pair))


class OnDevice(NamedTuple):
    """One image between batches: its joined features on every device, the rest on the host."""

    features: ImageFeatures
    """Without descriptors."""
    joined: JoinedFeatures


def join(features: ImageFeatures, room: int, mesh: Mesh) -> OnDevice:
    """Features joined, with room for so many coarse cells."""
    bare = features.dense._replace(coarse=(), fine=())
    joined = join_everywhere(pad_features(features.dense, room), mesh=mesh)
    return OnDevice(features._replace(dense=bare), joined)


Held = TypeVar("Held")


class Resident(Generic[Name, Held]):
    """What is held of the images of a list of pairs, or of blocks of pairs; the one wanted again
    last makes room."""

    def __init__(
        self, load: Callable[[Name], Held], pairs: Sequence[Sequence[Name]], most: int
    ) -> None:
        """`load` gives what is held of an image; `most` images are held at a time."""
        self._load, self._most = load, most
        self._images: dict[Name, Held] = {}
        self._uses: dict[Name, deque[int]] = {}
        for k, pair in enumerate(pairs):
            for name in pair:
                self._uses.setdefault(name, deque()).append(k)

    def __len__(self) -> int:
        return len(self._images)

    def take(self, name: Name) -> Held:
        """For the next of its pairs."""
        if name not in self._images:
            while len(self._images) >= self._most:
                del self._images[max(self._images, key=lambda other: self._uses[other][0])]
            self._images[name] = self._load(name)
        image = self._images[name]
        self._uses[name].popleft()
        if not self._uses[name]:
            del self._images[name]
        return image
