"""Which photos may show the same: the nearest neighbours of their descriptors."""

import importlib.metadata
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsfm.core.pooling import nearest
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.io.store import Store
from jaxsfm.io.weight_files import has_extras, is_converted
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.global_descriptors import Work, by_gem, by_netvlad, by_vlad
from jaxsfm.options import Retrieval


class Described(NamedTuple):
    """A collection's descriptors."""

    vectors: dict[str, np.ndarray]
    """float32, unit length, by the photos' names."""
    lost: list[tuple[ImageFile, ImageError]]
    """Photos that cannot be decoded, and why."""


def check_retrieval(kind: Retrieval, weights: Weights) -> None:
    """Raises UserError if photos cannot be described so with these weights."""
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
    """Every image with its `k` most similar ones, as a union of pairs in order of names.

    Depends on the photos and their names alone, not on their order.

    Raises:
      ImageError: an image cannot be decoded.
      UserError: `netvlad`, and the weights have no head.
    """
    found = described_alone(weights, images, kind=kind, execution=execution)
    for _, error in found.lost:
        raise error
    return nearest_pairs(found.vectors, k)


def described_alone(
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    kind: Retrieval,
    execution: Execution | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> Described:
    """As `described`; nothing is kept."""
    identity = {"version": importlib.metadata.version("jaxsfm"), "weights": weights.sha256}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        store = Store(Path(scratch), identity)
        return described(
            weights, images, kind=kind, store=store, execution=execution, on_image=on_image
        )


def described(
    weights: Weights,
    images: Iterable[ImageFile],
    *,
    kind: Retrieval,
    store: Store,
    execution: Execution | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> Described:
    """Descriptors of all images; what is in the store is not computed again.

    Args:
      store: of a run with these weights.
      on_image: told of every photo that has been through the network.

    Raises:
      UserError: `netvlad`, and the weights have no head.
    """
    check_retrieval(kind, weights)
    images = list(images)
    # Each content once, in an order that is nobody's choice.
    of_content = {image.sha256: image for image in images}
    unique = [of_content[sha256] for sha256 in sorted(of_content)]
    work = Work(weights, unique, store, execution, on_image)
    found = {"gem": by_gem, "vlad": by_vlad, "netvlad": by_netvlad}[kind](work)
    return Described(
        {image.name: found[image.sha256] for image in images if image.sha256 in found},
        [(image, work.lost[image.sha256]) for image in images if image.sha256 in work.lost],
    )


def nearest_pairs(vectors: Mapping[str, np.ndarray], k: int) -> list[Pair]:
    """Every name with the `k` nearest others (all, if there are not so many), as a union; equally
    near ones by name.

    Raises:
      ValueError: k is less than 1.
    """
    if k < 1:
        raise ValueError(f"k must be at least 1; got {k}")
    names = sorted(vectors)
    if len(names) < 2:
        return []
    table = jnp.asarray(np.stack([vectors[name] for name in names]))
    rows = np.asarray(nearest(table, k=min(k, len(names) - 1)))
    return sorted({make_pair(names[i], names[j]) for i, row in enumerate(rows) for j in row})
