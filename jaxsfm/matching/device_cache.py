"""Images' features that stay on the devices from pair to pair, and the order of pairs for that."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jax.sharding import Mesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxsfm.core.pair_shape import Products
from jaxsfm.core.sharded import join_everywhere
from jaxsfm.core.types import DenseFeatures, JoinedFeatures, OctavePart
from jaxsfm.io.features import ImageFeatures, pad_features
from jaxsfm.io.traced_programs import Traced

Name = TypeVar("Name")
Loaded = TypeVar("Loaded")

_join = Traced(join_everywhere, DenseFeatures, JoinedFeatures, OctavePart)


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
