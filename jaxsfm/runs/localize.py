"""Localization of photos in a finished run, whose models do not change.

Each photo is matched with photos of the run, and its pose is found in the model of which it shows
most (`jaxsfm.sfm.register.locate_view`). The result of a photo depends on its content, the run and
the options. It does not depend on the other photos of the same call, nor on the photo's name,
unless a list of known cameras names it.
"""

import dataclasses
import functools
import importlib.metadata
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.given_cameras import listed_name, parse_cameras
from jaxsfm.colmap.intrinsics import Intrinsics, KnownCameras
from jaxsfm.config import Refinement
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile, inspect_image, orientations
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.photo_folder import find_images
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import Store
from jaxsfm.matching.engines import chosen_engine
from jaxsfm.options import check_threads
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.further_matching import match_further, pairs_to_rematch
from jaxsfm.runs.job import Job
from jaxsfm.runs.localize_report import (
    LocalizationReport,
    LocalizedPhoto,
    UnusablePhoto,
    error_against,
)
from jaxsfm.runs.panoramas import refuse_panorama
from jaxsfm.runs.run_options import LocalizeOptions
from jaxsfm.runs.working_model import (
    CameraPrior,
    Shortlist,
    WorkingModel,
    camera_priors,
    photos_of_run,
    read_working_models,
    similar_photos,
    view_without_pose,
    weights_of_run,
)
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import ResectionMatches
from jaxsfm.sfm.register.locate_view import LocatedView, UnregisteredView, best_location, locate_in

MANY_INLIERS = 100
"""A pose that so many matches agree with is not looked for again. A photo of a sixth of the size
had 465, and alignment found 21 of the 30 points that it needs: further passes changed nothing."""
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


def localize_photos(
    photos: Sequence[Path],
    run: Path,
    *,
    options: LocalizeOptions,
    shortlist: Shortlist | None = None,
) -> LocalizationReport:
    """Localize photos in a finished run.

    Args:
      photos: files, or folders with files.
      run: the OUT of a run.
      shortlist: chooses the photos of the run that a photo is matched with; default: the
        `options.shortlist` most similar ones.

    Raises:
      UserError: there is no finished run with a model, its photos or weights are not there, or no
        usable photo was given.
    """
    engine = chosen_engine(options.engine)
    check_threads(options.threads)
    finished = read_run(run, images=options.images, reference=options.reference)
    if finished.model is None:
        raise UserError(f"{run}: this run has no model to localize photos in")
    models = read_working_models(finished)
    intrinsics = parse_cameras(options.intrinsics) if options.intrinsics else None
    usable, unusable = open_queries(photos)
    cameras = {
        path: camera_priors(
            dataclasses.replace(image, name=path),
            models,
            cameras_of_query(path, intrinsics),
            finished.photos.taken_with,
        )
        for path, image in usable.items()
    }
    weights = weights_of_run(finished, options.network)
    unknown = {image.name: image for image in usable.values()}
    shortlist = shortlist or similar_photos(
        finished, weights, options.shortlist, unknown, options.execution
    )
    queries = []
    for path, image in usable.items():
        own = finished.photos.name_of(image.sha256)
        names = sorted({v.name for model in models for v in model.views} - {own})
        try:
            queries.append(Query(path, image, cameras[path], shortlist(image, names)))
        except ImageError as error:
            unusable[path] = str(error)
    files = photos_of_run(finished, sorted({n for query in queries for n in query.shortlist}))
    rows: list[LocalizedPhoto | UnusablePhoto] = [
        UnusablePhoto(photo=path, why=why) for path, why in unusable.items()
    ]
    with tempfile.TemporaryDirectory(prefix="jaxsfm-") as scratch:
        temporary = Store(Path(scratch), to_json(finished.report.identity))
        job = Job(
            store=finished.store if options.keep_features else temporary,
            earlier=(finished.store,),
            weights=weights,
            config=finished.config,
            engine=engine,
            execution=options.execution,
            seed=finished.report.known_options.seed,
            progress=options.progress,
        )
        if lost := job.extract_missing(files.values()):
            raise UserError(lost[min(lost)])
        readable = Photos([*files.values(), *(q.image for q in queries)], finished.config)
        images = DeviceImages(readable.gray)
        bar = tqdm(total=len(queries), desc="localizing", unit="photo", disable=not job.progress)
        with bar:
            for query, matches in match_queries(job, queries, files):
                further = functools.partial(
                    match_further, job, {**files, query.image.name: query.image}
                )
                rows.append(_localize_query(query, matches, finished, models, images, further))
                bar.update()
    return LocalizationReport(
        version=importlib.metadata.version("jaxsfm"),
        model=str(run.absolute()),
        photos=sorted(rows, key=lambda row: row.photo),
    )


def locate_photo(
    query: Query,
    models: Sequence[WorkingModel],
    matches: Mapping[Pair, PairResult],
    images: DeviceImages,
) -> LocatedView:
    """Find the pose of a photo in the model of which it shows most (`Localization.support`)."""
    views = [
        view_without_pose(query.image, camera, model.config)
        for model, camera in zip(models, query.cameras, strict=True)
    ]
    wanted = UnregisteredView(views, query.cameras[0].estimated, query.shortlist)
    refinement = models[0].config.refinement or Refinement()
    resection = ResectionMatches(matches, models[0].seed)
    every = [each.model for each in models]
    return best_location(
        locate_in(every, k, wanted, resection, images, refinement=refinement)
        for k in range(len(every))
    )


def _localize_query(
    query: Query,
    matches: dict[Pair, PairResult] | str,
    run: FinishedRun,
    models: Sequence[WorkingModel],
    images: DeviceImages,
    further: Callable[[Iterable[Pair]], dict[Pair, PairResult]],
) -> LocalizedPhoto | UnusablePhoto:
    """The row of a photo, whose matches may be the reason why it has none.

    A photo whose pose is not trusted is matched further (`jaxsfm.runs.further_matching`), unless
    many matches agree with its pose: what is missing is then something else than matches.
    """
    try:
        if isinstance(matches, str):
            raise ImageError(matches)
        place, config = locate_photo(query, models, matches, images), models[0].config
        found = place.found
        if not found.trusted and found.inliers < MANY_INLIERS and config.max_rectified_planes:
            counts = {pair: result.counts for pair, result in matches.items()}
            least = config.min_inliers
            pairs = pairs_to_rematch([query.image.name], query.shortlist, counts, least=least)
            likely = further(pairs)
            every = matches | likely
            if likely:
                again = locate_photo(query, models, every, images)
                if again.found.trusted or not found.view:
                    place, matches = again, every
    except ImageError as error:
        return UnusablePhoto(photo=query.path, shortlist=query.shortlist, why=str(error))
    error, view = None, place.found.view
    if view is not None and run.reference is not None:
        name, reference = Path(query.path).name, run.reference.poses
        error = error_against(name, view, models[place.model].views, reference)
    return LocalizedPhoto(
        photo=query.path,
        in_run=run.photos.name_of(query.image.sha256),
        shortlist=query.shortlist,
        matches=sum(result.num_inliers for result in matches.values()),
        source=query.cameras[place.model].source,
        model=place.model,
        found=place.found,
        error=error,
    )


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
            refuse_panorama(image, "localize")
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
