"""Photos localized in a finished run: each is matched with photos of the run, and its pose found in
the model (`jaxsfm.sfm.register.locate_view`), which stays as it is.

A photo's result depends on its content, the run and the options; not on its name, nor on the other
photos of the same call.
"""

import dataclasses
import importlib.metadata
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.intrinsics import parse_intrinsics
from jaxsfm.colmap.model_arrays import part_of
from jaxsfm.config import Refinement
from jaxsfm.errors import UserError
from jaxsfm.io.features import ImageFeatures, room_of
from jaxsfm.io.images import (
    ImageError,
    ImageFile,
    find_images,
    inspect_image,
)
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.photos import Photos, Reader
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights
from jaxsfm.matching.execution import Execution
from jaxsfm.matching.extraction import extracted, image_features
from jaxsfm.matching.pair_matching import matched
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.runs.finished_model import (
    ChosenCamera,
    KnownModel,
    Shortlist,
    by_similarity,
    choose_camera,
    known_model,
    run_files,
    run_weights,
    view_of,
)
from jaxsfm.runs.localize_report import (
    Localization,
    LocalizedPhoto,
    UnusablePhoto,
    error_against,
    localized_photo,
)
from jaxsfm.sfm.register.locate_view import Located, locate


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalizeOptions:
    """What to do, beyond what the run fixes."""

    images: Path | None = None
    """Folder of the run's photos; None: where the run found them."""
    intrinsics: str | None = None
    """K.txt or MODEL:p1,p2,.. of the photos; None: the run's camera, if exactly one of this size is
    that of several photos, else one per photo, whose focal length is estimated."""
    reference: Path | None = None
    """Reference poses of the photos and of the run's."""
    network: WeightsChoice = USUAL_WEIGHTS
    shortlist: Shortlist | int = 20
    """Photos that a new one is matched with; a number: the most similar ones."""

    execution: Execution = dataclasses.field(default_factory=Execution)
    keep_features: bool = False
    """Of the run's photos, in its folder, for the next time (25 MB for 1536 x 1024)."""
    progress: bool = False

    def chosen_shortlist(
        self, run: FinishedRun, weights: Weights, new: Mapping[str, ImageFile]
    ) -> Shortlist:
        """As a function; `new` as in `by_similarity`."""
        if isinstance(self.shortlist, int):
            return by_similarity(run, weights, self.shortlist, new, self.execution)
        return self.shortlist


def locate_photo(
    image: ImageFile,
    chosen: ChosenCamera,
    model: KnownModel,
    shortlist: Sequence[str],
    matches: Mapping[Pair, PairResult],
    read: Reader,
) -> Located:
    """The pose of a photo from its matches with the shortlisted photos of a model."""
    views, tracks, _ = part_of(model.views, model.tracks, shortlist)
    return locate(
        view_of(image, chosen, model.config),
        views,
        tracks,
        matches,
        read,
        config=model.config.refinement or Refinement(),
        own_camera=chosen.own,
        seed=model.seed,
    )


def _queries(photos: Sequence[Path]) -> tuple[dict[str, ImageFile], dict[str, str]]:
    """Usable photos by their path as given (folders: all in them), and why others are not.

    A photo's name becomes its content's, which no photo of a run has.
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


@contextmanager
def _features(
    run: FinishedRun, weights: Weights, files: Mapping[str, ImageFile], options: LocalizeOptions
) -> Iterator[Callable[[str], ImageFeatures]]:
    """Features of the run's photos by name: kept ones, else computed once, on disk (meanwhile)."""
    with tempfile.TemporaryDirectory(prefix="jaxsfm-") as scratch:
        apart = Store(Path(scratch), run.report.identity.to_json())
        fresh = run.matches if options.keep_features else apart
        todo = [image for image in files.values() if not run.matches.has_features(image)]
        stream = extracted(weights, todo, config=run.config, execution=options.execution)
        quiet = not options.progress or not todo
        bar = tqdm(stream, total=len(todo), desc="extraction", unit="image", disable=quiet)
        for _, found in bar:
            if isinstance(found, ImageError):
                raise found
            fresh.save_features(found)

        def load(name: str) -> ImageFeatures:
            image = files[name]
            found = fresh.load_features(image) or run.matches.load_features(image)
            return found or image_features(weights, image, config=run.config)

        yield load


def localize(photos: Sequence[Path], run: Path, *, options: LocalizeOptions) -> dict[str, object]:
    """Localize photos in a finished run; returns plain JSON, with a row for each photo.

    See `localize_photos`, which returns the result as an object.
    """
    return localize_photos(photos, run, options=options).to_json()


def localize_photos(photos: Sequence[Path], run: Path, *, options: LocalizeOptions) -> Localization:
    """Localize photos in a finished run.

    Args:
      photos: files, or folders of them.
      run: a run's OUT.

    Raises:
      UserError: no finished run with a model, its photos or weights are not at hand, or no usable
        photo was given.
    """
    kept = read_run(run, images=options.images, reference=options.reference)
    if kept.model is None:
        raise UserError(f"{run}: this run has no model to localize photos in")
    seed = kept.report.options.seed
    model = known_model(kept.folder / "sparse" / "0", kept.config, seed=seed)
    intrinsics = parse_intrinsics(options.intrinsics) if options.intrinsics else None
    usable, unusable = _queries(photos)
    cameras = {path: choose_camera(i, model.views, intrinsics) for path, i in usable.items()}
    weights = run_weights(kept, options.network)
    names = [view.name for view in model.views]
    shortlists, unknown = {}, {image.name: image for image in usable.values()}
    shortlist = options.chosen_shortlist(kept, weights, unknown)
    for path, image in usable.items():
        own = kept.photos.name_of(image.sha256)
        try:
            shortlists[path] = shortlist(image, [name for name in names if name != own])
        except ImageError as error:
            unusable[path] = str(error)
    files = run_files(kept, sorted({name for some in shortlists.values() for name in some}))
    rows: list[LocalizedPhoto | UnusablePhoto] = [
        UnusablePhoto(photo=path, why=why) for path, why in unusable.items()
    ]
    with _features(kept, weights, files, options) as load:
        todo = {path: usable[path] for path in shortlists}
        read = Photos([*files.values(), *todo.values()], model.config).gray
        each = tqdm(todo.items(), desc="localizing", unit="photo", disable=not options.progress)
        for path, image in each:
            try:
                matches = _matches(image, shortlists[path], load, weights, model, options)
                found = locate_photo(image, cameras[path], model, shortlists[path], matches, read)
            except ImageError as error:
                listed = sorted(shortlists[path])
                rows.append(UnusablePhoto(photo=path, shortlist=listed, why=str(error)))
                continue
            error = None
            if found.view is not None and kept.reference is not None:
                name, reference = Path(path).name, kept.reference.poses
                error = error_against(name, found.view, model.views, reference)
            rows.append(
                localized_photo(
                    path,
                    found,
                    matches,
                    source=cameras[path].source,
                    in_run=kept.photos.name_of(image.sha256),
                    shortlist=shortlists[path],
                    error=error,
                )
            )
    return Localization(
        version=importlib.metadata.version("jaxsfm"),
        model=str(run.absolute()),
        photos=sorted(rows, key=lambda row: row.photo),
    )


def _matches(
    image: ImageFile,
    shortlist: Sequence[str],
    load: Callable[[str], ImageFeatures],
    weights: Weights,
    model: KnownModel,
    options: LocalizeOptions,
) -> dict[Pair, PairResult]:
    """Of one photo with its shortlist."""
    own = image_features(weights, image, config=model.config)

    def either(name: str) -> ImageFeatures:
        return own if name == image.name else load(name)

    sizes = {view.name: view.size for view in model.views}
    rooms = {name: room_of(sizes[name]) for name in shortlist} | {image.name: own.room}
    results = matched(
        either,
        rooms,
        [(image.name, name) for name in shortlist],
        config=model.config,
        seed=model.seed,
        execution=options.execution,
    )
    return {result.pair: result for result in results}
