"""Which photos may show the same scene: those with similar global descriptors."""

import contextlib
import importlib.metadata
import tempfile
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.core.retrieval import partners
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.io.store import Store
from jaxsfm.io.weight_files import has_extras, is_converted
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.global_descriptors import (
    PhotoCollection,
    gem_descriptors,
    netvlad_descriptors,
    vlad_descriptors,
)
from jaxsfm.options import Retrieval

CANDIDATES = 5
"""Partners of a photo are chosen among so many times more photos, the most similar ones. In a video
they then reach beyond its neighbours in time (docs/decisions/retrieval.md)."""
_partners = jax.jit(partners, static_argnames=("k", "candidates"))
_DESCRIBE = {"gem": gem_descriptors, "vlad": vlad_descriptors, "netvlad": netvlad_descriptors}


class GlobalDescriptors(NamedTuple):
    """One descriptor for each photo of a collection."""

    vectors: dict[str, np.ndarray]
    """float32, unit length, by the photos' names."""
    lost: list[tuple[ImageFile, ImageError]]


def check_retrieval(kind: Retrieval, weights: Weights) -> None:
    """Raise UserError unless photos can be described in a way with these weights."""
    if kind == "netvlad" and not (is_converted(weights.path) and has_extras(weights.path)):
        raise UserError(
            "--retrieval netvlad: needs NetVLAD's weights with their head (--weights; jaxsfm "
            f"weights convert makes them); {weights.path} has none"
        )


def shortlist(
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    k: int,
    kind: Retrieval = "vlad",
    execution: Execution | None = None,
) -> list[Pair]:
    """Pairs of each image with `k` partners, each pair once, in order of names.

    Partners are chosen by `partner_pairs`. The pairs depend on the photos and their names alone,
    not on their order.

    Raises:
      ImageError: an image cannot be decoded.
      UserError: the kind is `netvlad`, and the weights have no head.
    """
    found = describe_photos(weights, images, kind=kind, execution=execution)
    for _, error in found.lost:
        raise error
    return partner_pairs(found.vectors, k)


def describe_photos(
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    kind: Retrieval,
    store: Store | None = None,
    execution: Execution | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> GlobalDescriptors:
    """Describe photos; descriptors that are in the store are not computed again.

    Args:
      store: of a run with these weights; None: nothing is kept.
      on_image: called for every photo that has been through the network.

    Raises:
      UserError: the kind is `netvlad`, and the weights have no head.
    """
    check_retrieval(kind, weights)
    images = list(images)
    # Each content is described once, in an order that does not depend on the caller.
    of_content = {image.content: image for image in images}
    unique = [of_content[content] for content in sorted(of_content)]
    with contextlib.ExitStack() as stack:
        if store is None:
            scratch = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
            identity = {"version": importlib.metadata.version("jaxsfm"), "weights": weights.sha256}
            store = Store(Path(scratch), identity)
        collection = PhotoCollection(weights, unique, store, execution, on_image)
        found = _DESCRIBE[kind](collection)
    lost = collection.lost
    return GlobalDescriptors(
        {image.name: found[image.content] for image in images if image.content in found},
        [(image, lost[image.content]) for image in images if image.content in lost],
    )


def partner_pairs(
    vectors: Mapping[str, np.ndarray], k: int, frame_of: Mapping[str, Hashable] | None = None
) -> list[Pair]:
    """Pairs of each name with `k` partners, each pair once, in order of names.

    Partners are similar to it, and differ from each other (`jaxsfm.core.retrieval`). With fewer
    than `k` other names, all of them are partners. Equally similar ones are taken by name.

    Args:
      vectors: global descriptors of unit length, float32 (c,).
      frame_of: the frame of photos that rigs have taken. Photos of one frame are no partners: they
        overlap and were taken from one place.

    Raises:
      ValueError: k is less than 1.
    """
    if k < 1:
        raise ValueError(f"k must be at least 1; got {k}")
    names = sorted(vectors)
    if len(names) < 2:
        return []
    table = jnp.asarray(np.stack([vectors[name] for name in names]))
    few = min(k, len(names) - 1)
    frames = [(frame_of or {}).get(name, name) for name in names]
    numbers = {frame: number for number, frame in enumerate(dict.fromkeys(frames))}
    group = jnp.asarray([numbers[frame] for frame in frames], jnp.int32)
    rows = np.asarray(_partners(table, k=few, candidates=CANDIDATES * k, group=group))
    found = ((i, j) for i, row in enumerate(rows) for j in row if frames[i] != frames[j])
    return sorted({make_pair(names[i], names[j]) for i, j in found})
