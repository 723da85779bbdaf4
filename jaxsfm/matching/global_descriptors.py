"""One descriptor for each photo of a collection, kept in a store.

Photos are described at a small size of their own, whatever the preset. So a descriptor depends on
the photo and the weights alone; that of VLAD depends also on the collection, because its vocabulary
is fitted on it. Local descriptors are kept in the store; memory holds a sample of bounded size.
"""

import functools
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.config import MIN_SIDE, Config
from jaxsfm.core.retrieval import NetVLADHead, Vocabulary, fit_vocabulary, gem, netvlad, vlad
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess
from jaxsfm.io import interrupt
from jaxsfm.io.features import padded_cells, padded_size
from jaxsfm.io.images import ImageError, ImageFile, read_image
from jaxsfm.io.store import Store, digest
from jaxsfm.io.weight_files import read_extras
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import extract_images

SIDE, NETVLAD_SIDE = 480, 640
"""Longer side of a photo that is described, pixels. GeM and VLAD find no more at 640 than at 480
(docs/decisions/retrieval.md). The authors of NetVLAD describe photos of 640 x 480."""
SAMPLE = 1 << 14
"""Number of local descriptors that a vocabulary is fitted on, over all photos (34 MB)."""
CELLS = f"cells {SIDE}"
"""The kind of local descriptors in the store."""
GEM = f"gem {SIDE}"
"""The kind of GeM descriptors in the store."""
ByContent = dict[str, np.ndarray]
"""Descriptors by `ImageFile.content`."""
_gem, _vlad, _netvlad, _fit = (jax.jit(f) for f in (gem, vlad, netvlad, fit_vocabulary))


@dataclass(frozen=True)
class PhotoCollection:
    """Photos that are described together, and the store that keeps their descriptors."""

    weights: Weights
    unique: list[ImageFile]
    """One photo of each content, in order of the contents."""
    store: Store
    execution: Execution | None
    on_image: Callable[[], object]
    """Called for every photo that has been through the network."""
    lost: dict[str, ImageError] = field(default_factory=dict)
    """Errors of photos that cannot be decoded, by content; added while photos are described."""

    def stored(self, kind: str) -> ByContent:
        """All descriptors of this kind that are in the store."""
        found = {image.content: self.store.load_descriptor(image, kind) for image in self.unique}
        return {content: each for content, each in found.items() if each is not None}

    def missing(self, have: Collection[str]) -> list[ImageFile]:
        """The photos whose content is not in `have`."""
        return [image for image in self.unique if image.content not in have]


def gem_descriptors(collection: PhotoCollection) -> ByContent:
    """The generalised mean of each photo's coarse descriptors, float32 (c,)."""
    found = collection.stored(GEM)
    for image, rows in _decoded(collection, _coarse_rows(collection, collection.missing(found))):
        found[image.content] = np.asarray(_gem(_padded(rows)))
        collection.store.save_descriptor(image, GEM, found[image.content])
    return found


def vlad_descriptors(collection: PhotoCollection) -> ByContent:
    """VLAD of each photo's coarse descriptors, with a vocabulary fitted on the collection."""
    found = collection.stored(_vlad_kind(collection.unique))
    if len(found) == len(collection.unique):
        return found
    todo = [
        image
        for image in collection.unique
        if collection.store.load_descriptor(image, CELLS) is None
    ]
    for image, rows in _decoded(collection, _coarse_rows(collection, todo)):
        collection.store.save_descriptor(image, CELLS, rows)
    good = collection.missing(collection.lost)
    kind = _vlad_kind(good)
    found = collection.stored(kind)
    todo = [image for image in good if image.content not in found]
    words = _vocabulary(collection, good) if todo else None
    for image in todo:
        interrupt.check()
        rows = _padded(_local_descriptors(collection, image))
        found[image.content] = np.asarray(_vlad(rows, words))
        collection.store.save_descriptor(image, kind, found[image.content])
    return found


def netvlad_descriptors(collection: PhotoCollection) -> ByContent:
    """NetVLAD of each photo, with the head that is in the file of the weights."""
    kind = f"netvlad {NETVLAD_SIDE}"
    found = collection.stored(kind)
    todo = collection.missing(found)
    if not todo:
        return found
    extras = read_extras(collection.weights.path)
    head = NetVLADHead(*(jnp.asarray(extras[f"netvlad.{name}"]) for name in NetVLADHead._fields))
    for image, rows in _decoded(collection, _conv5_rows(collection.weights, todo)):
        found[image.content] = np.asarray(_netvlad(rows, head))
        collection.store.save_descriptor(image, kind, found[image.content])
    return found


def _vlad_kind(images: Iterable[ImageFile]) -> str:
    return f"vlad {SIDE} {SAMPLE} {digest(sorted(image.content for image in images))}"


def _vocabulary(collection: PhotoCollection, good: list[ImageFile]) -> Vocabulary:
    """Fit a vocabulary on random cells, equally many of each photo and `SAMPLE` in all."""
    each = max(1, SAMPLE // len(good))
    sample: list[np.ndarray] = []
    for image in good[:SAMPLE]:
        rows = _local_descriptors(collection, image)
        order = np.random.default_rng(image.identity).permutation(len(rows))
        sample.append(rows[order[:each]])
    together = np.concatenate(sample)
    full = np.zeros((SAMPLE, together.shape[1]), np.float32)
    full[: len(together)] = together
    return _fit(jax.random.key(0), full)


def _decoded(
    collection: PhotoCollection, stream: Iterator[tuple[ImageFile, np.ndarray | ImageError]]
) -> Iterator[tuple[ImageFile, np.ndarray]]:
    """Yield the photos that could be decoded; the others go to `collection.lost`."""
    for image, rows in stream:
        interrupt.check()
        if isinstance(rows, ImageError):
            collection.lost[image.content] = rows
        else:
            yield image, rows
        collection.on_image()


def _coarse_rows(
    collection: PhotoCollection, images: list[ImageFile]
) -> Iterator[tuple[ImageFile, np.ndarray | ImageError]]:
    """Yield photos with their coarse descriptors of unit length, float16 (cells, c)."""
    for side, some in itertools.groupby(sorted(images, key=_side), key=_side):
        config = Config(max_size=side, backbone=collection.weights.backbone, keypoints="grid")
        stream = extract_images(
            collection.weights, some, config=config, execution=collection.execution
        )
        for image, found in stream:
            if isinstance(found, ImageError):
                yield image, found
            else:
                cells = int(np.prod(found.dense.coarse_grid))
                yield image, np.asarray(found.dense.coarse[0][:cells])


def _local_descriptors(collection: PhotoCollection, image: ImageFile) -> np.ndarray:
    """A photo's local descriptors from the store; if missing there, they are made again."""
    rows = collection.store.load_descriptor(image, CELLS)
    if rows is None:
        ((_, rows),) = _coarse_rows(collection, [image])
        if isinstance(rows, ImageError):
            raise rows
        collection.store.save_descriptor(image, CELLS, rows)
    return rows


def _side(image: ImageFile, least: int = SIDE) -> int:
    """Longer side at which an image is described, pixels: more for a very elongated one."""
    return max(least, math.ceil(MIN_SIDE * max(image.size) / min(image.size)))


def _padded(rows: np.ndarray) -> np.ndarray:
    """Rows as float32, padded with zeros to `padded_cells` so that few programs are compiled."""
    full = np.zeros((padded_cells(len(rows)), rows.shape[1]), np.float32)
    full[: len(rows)] = rows
    return full


def _conv5_rows(
    weights: Weights, images: list[ImageFile]
) -> Iterator[tuple[ImageFile, np.ndarray | ImageError]]:
    """Yield photos with conv5_3 before its rectifier, float32 (cells, 512); padding is zero."""
    params = jax.device_put(weights.params)
    for image in images:
        try:
            rgb = read_image(image, max_size=_side(image, NETVLAD_SIDE), upright=True).rgb
        except ImageError as error:
            yield image, error
            continue
        height, width = rgb.shape[:2]
        padded = np.zeros((*padded_size((width, height)), 3), np.uint8)
        padded[:height, :width] = rgb
        size = np.asarray([height, width], np.int32)
        maps = np.asarray(_conv5(params, padded, size, of=weights.preprocessing))
        yield image, maps.reshape(-1, maps.shape[-1])


@functools.partial(jax.jit, static_argnames=("of",))
def _conv5(params: dict, image: jax.Array, size: jax.Array, *, of: Preprocessing) -> jax.Array:
    maps = VGG16().apply(params, preprocess(image, of)[None], size[None], method="conv5")
    assert isinstance(maps, jax.Array)
    return maps
