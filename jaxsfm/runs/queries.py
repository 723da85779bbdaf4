"""Queries: the photos of one call of `localize`, from their paths to their matches."""

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from jaxsfm.colmap.given_cameras import listed_name
from jaxsfm.colmap.intrinsics import Intrinsics, KnownCameras
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile, inspect_image, orientations
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.photo_folder import find_images
from jaxsfm.io.store import Store
from jaxsfm.runs.job import Job
from jaxsfm.runs.working_model import CameraPrior

PHOTOS_TOGETHER = 64
"""Photos whose features and matches are asked from workers in one call: workers take seconds to
start, and the features of so many photos take 1.6 GB on the disk."""


@dataclasses.dataclass(frozen=True)
class Query:
    """A photo that is to be localized."""

    path: str
    """Its path, as it was given."""
    image: ImageFile
    """Its name is made of its content, so that it is no name of a photo of the run."""
    cameras: Sequence[CameraPrior]
    """The camera that it starts with, in each model of the run."""
    shortlist: Sequence[str]
    """Names of the photos of the run that it is matched with."""


def open_queries(photos: Sequence[Path]) -> tuple[dict[str, ImageFile], dict[str, str]]:
    """Find photos, in folders too, and read their headers.

    Returns:
      The usable photos, and the reasons why others are not usable, both by path as given.
    """
    paths, usable, unusable = [], {}, {}
    for path in photos:
        try:
            paths += [path / name for name in find_images(path)] if path.is_dir() else [path]
        except UserError as error:
            unusable[str(path)] = str(error)
    for path in dict.fromkeys(paths):
        try:
            image = inspect_image(path, name=str(path))
            usable[str(path)] = dataclasses.replace(image, name=f"photo {image.sha256}")
        except ImageError as error:
            unusable[str(path)] = str(error)
    if not usable:
        raise UserError(next(iter(unusable.values()), "no photos to localize were given"))
    return usable, unusable


def cameras_of_query(path: str, known: KnownCameras | None) -> KnownCameras | None:
    """The known cameras, where a photo has its path, as it was given, for a name.

    Raises:
      UserError: the cameras are those of a list, and the photo is not on it.
    """
    if known is None or isinstance(known, Intrinsics):
        return known
    name = listed_name(Path(path), known)
    if name is None:
        raise UserError(f"--intrinsics: the list has no camera of {path}")
    return {path: known[name]}


def match_queries(
    job: Job, queries: Sequence[Query], files: Mapping[str, ImageFile]
) -> Iterator[tuple[Query, dict[Pair, PairResult] | str]]:
    """Yield every query with its matches, or with the reason why it has none.

    The queries' features and matches lie in a temporary folder. Without workers the queries are
    taken one by one, so that little lies there.

    Args:
      job: has the features of the run's photos.
      files: the photos of the run that are on the shortlists.
    """
    together = PHOTOS_TOGETHER if job.engine.starts_workers else 1
    for k in range(0, len(queries), together):
        group = queries[k : k + together]
        own = {query.image.name: query.image for query in group}
        images = {**files, **own}
        identity = {
            **job.store.identity,
            "images": {name: image.sha256 for name, image in images.items()},
            "orientations": orientations(images.values()),
        }
        with tempfile.TemporaryDirectory(prefix="jaxsfm-") as scratch:
            part = dataclasses.replace(
                job,
                store=Store(Path(scratch), identity),
                earlier=(job.store, *job.earlier),
                progress=False,
            )
            lost = part.extract_missing(own.values())
            pairs = {
                query.path: [make_pair(query.image.name, name) for name in query.shortlist]
                for query in group
                if query.image.name not in lost
            }
            todo = list(dict.fromkeys(pair for some in pairs.values() for pair in some))
            try:
                found = {result.pair: result for result in part.match_missing(images, todo)}
            except ImageError as error:  # a photo of the run is gone, and so are its features
                found, lost = {}, dict.fromkeys(own, str(error))
        for query in group:
            why = lost.get(query.image.name)
            yield query, why or {pair: found[pair] for pair in pairs[query.path]}
