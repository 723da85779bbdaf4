"""Which photos of a finished run a new photo is matched with: those that look most similar."""

import contextlib
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from jaxsfm.core.partners import TIE
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.global_descriptors import GEM
from jaxsfm.matching.retrieval import describe_photos
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.runs.working_model import photos_of_run

Shortlist = Callable[[ImageFile, Sequence[str]], Sequence[str]]
"""From a photo and the names of other photos to the names of those that it is matched with."""


def similar_photos(
    run: FinishedRun,
    weights: Weights,
    k: int,
    new: Mapping[str, ImageFile],
    execution: Execution,
) -> Shortlist:
    """A shortlist of the `k` most similar photos; equally similar ones are taken by name.

    Photos are compared by GeM, which describes each photo by itself. The descriptors of the run's
    photos are kept in its folder, if it can be written. The shortlist raises ImageError if the
    photo that it is called with cannot be decoded.

    Args:
      new: photos that are not in the run, by name.

    Raises:
      UserError: k is less than 1.
    """
    if k < 1:
        raise UserError(f"--shortlist must be at least 1; got {k}")

    def describe(image: ImageFile, store: Store | None = None) -> np.ndarray:
        found = describe_photos(weights, [image], kind="gem", store=store, execution=execution)
        for _, error in found.lost:
            raise error
        return found.vectors[image.name]

    @functools.cache
    def descriptor(name: str) -> np.ndarray:
        if name in new:
            return describe(new[name])
        saved = run.store.load_descriptor(run.photos.recorded(name), GEM)
        if saved is not None:
            return saved
        image = photos_of_run(run, [name])[name]
        try:
            return describe(image, run.store)
        except ImageError:
            raise
        except UserError:  # the run's folder cannot be written
            return describe(image)

    def shortlist(image: ImageFile, names: Sequence[str]) -> Sequence[str]:
        if k >= len(names):
            return names
        own, nearness = descriptor(image.name), {}
        for name in names:
            with contextlib.suppress(ImageError):  # the other photo cannot be decoded
                nearness[name] = round(float(descriptor(name) @ own) / TIE)
        return sorted(nearness, key=lambda name: (-nearness[name], name))[:k]

    return shortlist
