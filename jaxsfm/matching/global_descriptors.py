"""One descriptor for each photo of a collection, kept in a store.

Photos are described at a small size of their own, whatever the preset, so a descriptor depends on
the photo and the weights alone; VLAD's also on the collection, which its vocabulary is fitted on.
Of the local descriptors a bounded sample is held, the others lie in the store.
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
from jaxsfm.core.pooling import NetVLADHead, gem, netvlad, vlad
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess
from jaxsfm.core.vocabulary import Vocabulary, fit_vocabulary
from jaxsfm.io import interrupt
from jaxsfm.io.features import padded_cells, padded_size
from jaxsfm.io.images import ImageError, ImageFile, read_image
from jaxsfm.io.store import Store, digest
from jaxsfm.io.weight_files import read_extras
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import extracted

SIDE, NETVLAD_SIDE = 480, 640
"""Longer side of a photo that is described, pixels: at 640 GeM and VLAD find no more than at 480
(docs/guide/many-photos.md); NetVLAD's authors describe photos of 640 x 480."""
SAMPLE = 1 << 14
"""Local descriptors that a vocabulary is fitted on, over all photos: 34 MB, however many."""
CELLS = f"cells {SIDE}"
"""What local descriptors are called in the store."""
GEM = f"gem {SIDE}"
"""What its descriptors are called in the store."""
Found = dict[str, np.ndarray]
"""Descriptors by content (SHA-256)."""
_gem, _vlad, _netvlad, _fit = (jax.jit(f) for f in (gem, vlad, netvlad, fit_vocabulary))


@dataclass(frozen=True)
class Work:
    """What is to be described, and where descriptors are kept."""

    weights: Weights
    unique: list[ImageFile]
    """Each content once, in order of the contents' hashes."""
    store: Store
    execution: Execution | None
    on_image: Callable[[], object]
    """Told of every photo that has been through the network."""
    lost: dict[str, ImageError] = field(default_factory=dict)
    """Contents that could not be decoded, and why; grows."""

    def load(self, image: ImageFile, kind: str) -> np.ndarray | None:
        """An array in the store; None if it is not there, or damaged."""
        return (self.store.load_descriptor(image, kind) or {}).get("array")

    def save(self, image: ImageFile, kind: str, array: np.ndarray) -> None:
        """Keep an array."""
        self.store.save_descriptor(image, kind, {"array": array})

    def stored(self, kind: str) -> Found:
        """All descriptors of this kind that are in the store."""
        found = {image.sha256: self.load(image, kind) for image in self.unique}
        return {sha256: each for sha256, each in found.items() if each is not None}

    def missing(self, have: Collection[str]) -> list[ImageFile]:
        """Photos whose contents are not in `have`."""
        return [image for image in self.unique if image.sha256 not in have]


def by_gem(work: Work) -> Found:
    """Generalised means of the coarse descriptors."""
    found = work.stored(GEM)
    for image, rows in _noted(work, _rows(work, work.missing(found))):
        found[image.sha256] = np.asarray(_gem(_padded(rows)))
        work.save(image, GEM, found[image.sha256])
    return found


def by_vlad(work: Work) -> Found:
    """VLAD of the coarse descriptors, with the collection's vocabulary."""
    found = work.stored(_vlad_kind(work.unique))
    if len(found) == len(work.unique):
        return found
    here = {image.sha256 for image in work.unique if work.load(image, CELLS) is not None}
    for image, rows in _noted(work, _rows(work, work.missing(here))):
        work.save(image, CELLS, rows)
    good = work.missing(work.lost)
    kind = _vlad_kind(good)
    found = work.stored(kind)
    todo = [image for image in good if image.sha256 not in found]
    words = _vocabulary(work, good) if todo else None
    for image in todo:
        interrupt.check()
        found[image.sha256] = np.asarray(_vlad(_padded(_again(work, image)), words))
        work.save(image, kind, found[image.sha256])
    return found


def by_netvlad(work: Work) -> Found:
    """NetVLAD with the head that the weights bring."""
    kind = f"netvlad {NETVLAD_SIDE}"
    found = work.stored(kind)
    todo = work.missing(found)
    if not todo:
        return found
    extras = read_extras(work.weights.path)
    head = NetVLADHead(*(jnp.asarray(extras[f"netvlad.{name}"]) for name in NetVLADHead._fields))
    for image, rows in _noted(work, _conv5_rows(work.weights, todo)):
        found[image.sha256] = np.asarray(_netvlad(rows, head))
        work.save(image, kind, found[image.sha256])
    return found


def _vlad_kind(images: Iterable[ImageFile]) -> str:
    return f"vlad {SIDE} {SAMPLE} {digest(sorted(image.sha256 for image in images))}"


def _vocabulary(work: Work, good: list[ImageFile]) -> Vocabulary:
    """Fitted on as many random cells of each photo as make up `SAMPLE`."""
    each = max(1, SAMPLE // len(good))
    sample: list[np.ndarray] = []
    for image in good[:SAMPLE]:
        rows = _again(work, image)
        order = np.random.default_rng(image.identity).permutation(len(rows))
        sample.append(rows[order[:each]])
    together = np.concatenate(sample)
    full = np.zeros((SAMPLE, together.shape[1]), np.float32)
    full[: len(together)] = together
    return _fit(jax.random.key(0), full)


def _noted(
    work: Work, stream: Iterator[tuple[ImageFile, np.ndarray | ImageError]]
) -> Iterator[tuple[ImageFile, np.ndarray]]:
    """The photos that could be decoded; the others go to `work.lost`."""
    for image, rows in stream:
        interrupt.check()
        if isinstance(rows, ImageError):
            work.lost[image.sha256] = rows
        else:
            yield image, rows
        work.on_image()


def _rows(
    work: Work, images: list[ImageFile]
) -> Iterator[tuple[ImageFile, np.ndarray | ImageError]]:
    """Unit coarse descriptors, float16 (cells, c)."""
    for side, some in itertools.groupby(sorted(images, key=_side), key=_side):
        config = Config(max_size=side, backbone=work.weights.backbone, keypoints="grid")
        stream = extracted(work.weights, some, config=config, execution=work.execution)
        for image, found in stream:
            if isinstance(found, ImageError):
                yield image, found
            else:
                cells = int(np.prod(found.dense.coarse_grid))
                yield image, np.asarray(found.dense.coarse[0][:cells])


def _again(work: Work, image: ImageFile) -> np.ndarray:
    """Kept local descriptors; made again if they were damaged or deleted meanwhile."""
    rows = work.load(image, CELLS)
    if rows is None:
        ((_, rows),) = _rows(work, [image])
        if isinstance(rows, ImageError):
            raise rows
        work.save(image, CELLS, rows)
    return rows


def _side(image: ImageFile, least: int = SIDE) -> int:
    """Longer side at which an image is described; of very long ones more."""
    return max(least, math.ceil(MIN_SIDE * max(image.size) / min(image.size)))


def _padded(rows: np.ndarray) -> np.ndarray:
    """float32, with zero rows up to `padded_cells`, so that few programs are compiled."""
    full = np.zeros((padded_cells(len(rows)), rows.shape[1]), np.float32)
    full[: len(rows)] = rows
    return full


def _conv5_rows(
    weights: Weights, images: list[ImageFile]
) -> Iterator[tuple[ImageFile, np.ndarray | ImageError]]:
    """conv5_3 before its rectifier, float32 (cells, 512); zero rows are padding."""
    params = jax.device_put(weights.params)
    for image in images:
        try:
            rgb = read_image(image, max_size=_side(image, NETVLAD_SIDE)).rgb
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
