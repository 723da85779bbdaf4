"""Extension of a finished run by photos that were added to its folder of photos since.

New photos are matched with their shortlists only. Each is registered in the model that it fits
best. The poses and points of the models do not change, and new photos add points of their own
(`jaxsfm.sfm.register.grow`). Their matches are kept in the run's folder, so a later reconstruction
of all photos continues from them.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.extend_database import (
    add_images,
    add_matches,
    copy_database,
    used_by_colmap,
)
from jaxsfm.colmap.formats.database import check_database
from jaxsfm.colmap.given_cameras import parse_cameras
from jaxsfm.colmap.model_files import read_models, write_models
from jaxsfm.colmap.reconstruction import colour_points
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.errors import UserError
from jaxsfm.io.entries import RECORD, VIEWS, VIEWS_RECORD
from jaxsfm.io.images import ImageError, ImageFile, shown_name
from jaxsfm.io.libraries import versions
from jaxsfm.io.pairs import make_pair
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import SavedMatches
from jaxsfm.io.work_folder import lock_folder, open_locked_folder
from jaxsfm.matching.engines import Engine, chosen_engine
from jaxsfm.matching.pipeline import open_images
from jaxsfm.options import check_threads
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.page import page_after_run
from jaxsfm.report.run_report import RunReport, write_report
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.build_report import NewPhotos, extended_report
from jaxsfm.runs.job import Job, images_of, pairs_without
from jaxsfm.runs.panoramas import refuse_panorama
from jaxsfm.runs.run_options import LocalizeOptions
from jaxsfm.runs.working_model import (
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
from jaxsfm.sfm.register.grow import grow
from jaxsfm.sfm.register.locate_view import UnregisteredView


def extend_run(
    run: Path, *, options: LocalizeOptions, shortlist: Shortlist | None = None
) -> RunReport | None:
    """Extend a finished run by the photos that were added to its folder of photos since.

    Args:
      run: the OUT of a run.
      shortlist: chooses the photos that a new photo is matched with; default: the
        `options.shortlist` most similar ones.

    Returns:
      The new report, whose `extended` has a row for every extension; None if there are no new
      photos, not even broken ones.

    Raises:
      UserError: there is no finished run with a model, or its photos or weights are not there.
    """
    engine = chosen_engine(options.engine)
    check_threads(options.threads)
    if not (run / RECORD).exists():
        raise UserError(f"{run}: no finished run here ({RECORD} is missing)")
    with lock_folder(run):  # before anything is read: another process may be publishing
        return _extend(run, engine, options, shortlist)


def _extend(
    run: Path, engine: Engine, options: LocalizeOptions, shortlist: Shortlist | None
) -> RunReport | None:
    start = time.monotonic()
    finished = read_run(run, images=options.images, reference=options.reference)
    if finished.model is None:
        raise UserError(f"{run}: this run has no model to extend")
    if (run / VIEWS / VIEWS_RECORD).exists():
        raise UserError(
            f"{run}: a run of 360-degree photos cannot be extended; run reconstruct again with all "
            "photos, which keeps the views and matches that are there"
        )
    if finished.photos.folder is None:
        raise UserError(f"{run}: where its photos lie is not known; say it with --images")
    weights, identity = weights_of_run(finished, options.network), finished.report.identity
    if identity.version != versions()["jaxsfm"]:
        raise UserError(
            f"{run}: was made by jaxsfm {identity.version}, this is {versions()['jaxsfm']}; "
            "run reconstruct again"
        )
    usable, broken = open_images(finished.photos.folder, progress=options.progress)
    images, skipped = _added_photos(finished, usable, broken)
    images = {name: finished.photos.with_own_mask(image) for name, image in images.items()}
    if not images and not skipped:
        return None
    models = read_working_models(finished)
    if any(each.model.rigs for each in models):
        raise UserError(f"{run}: a model with rigs cannot be extended; run reconstruct again")
    _check_database(run / "database.db", models)
    names = sorted({view.name for model in models for view in model.views})
    files = _unchanged_photos(finished, usable, names) | images
    intrinsics = parse_cameras(options.intrinsics) if options.intrinsics else None
    taken_with = finished.photos.taken_with
    cameras = {
        name: camera_priors(image, models, intrinsics, taken_with) for name, image in images.items()
    }
    identity = identity.with_images(images.values())
    folder = open_locked_folder(run, to_json(identity))
    job = Job(
        store=folder,
        weights=weights,
        config=finished.config,
        engine=engine,
        execution=options.execution,
        seed=finished.report.known_options.seed,
        progress=options.progress,
    )
    shortlist = shortlist or similar_photos(
        finished, weights, options.shortlist, images, options.execution
    )
    matches, lost = _match_new(job, files, [*names, *images], images, shortlist)
    if lost_by_run := lost.keys() & set(names):
        raise UserError(lost[min(lost_by_run)])
    images = {name: image for name, image in images.items() if name not in lost}
    new = NewPhotos(images, cameras, skipped | lost)
    photos = Photos(files.values(), finished.config)
    with folder.publish() as target:
        report = write_extension(target, finished, models, new, photos, matches, options)
        took = report.seconds.get("extension", 0.0) + time.monotonic() - start
        seconds = report.seconds | {"extension": took}
        report = dataclasses.replace(report, identity=identity, seconds=seconds)
        write_report(target, report)
    if not options.keep_features:
        folder.drop_features()
    page_after_run(run)
    return report


def _added_photos(
    run: FinishedRun, usable: list[ImageFile], broken: dict[str, str]
) -> tuple[dict[str, ImageFile], dict[str, str]]:
    """The photos in the folder that the run has not used, and why others cannot be used, by name.

    A photo that the run skipped is new if its file has changed, or if it was not damaged.
    """
    skipped = run.report.images.skipped
    used = run.report.identity.images.keys() - skipped.keys()
    others = {name.removesuffix(Path(name).suffix) for name in used}
    fresh = [
        i
        for i in usable
        if i.name not in used
        and i.name.removesuffix(i.path.suffix) not in others  # the same photo in another format
        and not run.store.why_unusable(i)
    ]
    unusable = {n: why for n, why in broken.items() if n not in used and n not in skipped}
    added = {image.name: image for image in fresh}
    if run.report.options.get("panorama") != "no":
        for image in fresh:
            try:
                refuse_panorama(image, "extend")
            except ImageError as error:
                del added[image.name]
                unusable |= {image.name: str(error)} if image.name not in skipped else {}
    return added, unusable


def _unchanged_photos(
    run: FinishedRun, usable: list[ImageFile], needed: list[str]
) -> dict[str, ImageFile]:
    """The photos of the run that are still what they were, by name; UserError if one of the needed
    photos is not."""
    report = run.report
    used = {n: h for n, h in report.identity.images.items() if n not in report.images.skipped}
    there = {
        image.name: run.photos.as_described(image)
        for image in usable
        if used.get(image.name) == image.sha256
    }
    # One that is gone is named. One of which there is another format now is still there.
    return there | photos_of_run(run, [name for name in needed if name not in there])


def _match_new(
    job: Job,
    files: Mapping[str, ImageFile],
    names: list[str],
    added: Mapping[str, ImageFile],
    shortlist: Shortlist,
) -> tuple[SavedMatches, dict[str, str]]:
    """Match new photos with their shortlists; returns also why photos cannot be decoded, by name.

    Args:
      files: the run's photos and the new ones.
      names: the photos that may be on a shortlist: those of the models, and the new ones.
    """
    shortlists, lost = {}, {}
    for name, image in added.items():
        try:
            shortlists[name] = shortlist(image, [n for n in sorted(names) if n != name])
        except ImageError as error:
            lost[name] = str(error)
            job.store.record_failure(image, error)
    pairs = sorted({make_pair(a, b) for a, others in shortlists.items() for b in others})
    missing = [pair for pair in pairs if job.store.load_matches(pair) is None]
    lost |= job.extract_missing(images_of(missing, files))
    if not lost.keys() - added.keys():
        for _ in job.match_missing(files, pairs_without(missing, lost)):
            pass
    return SavedMatches(job.store, pairs_without(pairs, lost)), lost


def _check_database(database: Path, working: Sequence[WorkingModel]) -> None:
    """Raise UserError if a run's database is damaged, or numbers the photos of its models
    differently."""
    ids = check_database(database, where=str(database))
    for view in (view for model in working for view in model.views):
        if ids.get(view.name) != view.image_id:
            raise UserError(
                f"{database}: is not of the run's models: {shown_name(view.name)} is photo "
                f"{view.image_id} there, and {ids.get(view.name, 'none')} in the database"
            )


def write_extension(
    target: Path,
    run: FinishedRun,
    working: Sequence[WorkingModel],
    new: NewPhotos,
    photos: Photos,
    matches: SavedMatches,
    options: LocalizeOptions,
) -> RunReport:
    """Register the new photos, and write the database and the models into `target`.

    Args:
      working: the models of the run.
      photos: the run's photos and the new ones.
      matches: the matches of the new photos with their shortlists.
    """
    source, database = run.folder / "database.db", target / "database.db"
    count = sum(result.num_inliers for result in matches.values())
    copy_database(source, database, count)
    seed, config = run.report.known_options.seed, run.config
    verification = VerificationOptions(
        seed=seed, threads=options.threads, scale=photos.median_scale()
    )
    with used_by_colmap(source):
        # A camera of the run has the same number in all models, and a new one has none yet.
        added = add_images(
            database, {n: (i, new.cameras[n][0].camera) for n, i in new.images.items()}
        )
        verified = add_matches(database, matches, verification)
    unregistered = {}
    for name, (image_id, in_database) in added.items():
        views = [
            dataclasses.replace(
                view_without_pose(new.images[name], prior, config),
                image_id=image_id,
                # A model has the run's camera refined; the database has it as it was before.
                camera=prior.camera if prior.source == "run" else in_database,
            )
            for prior in new.cameras[name]
        ]
        others = {other for pair in matches if name in pair for other in pair} - {name}
        estimated = new.cameras[name][0].estimated
        unregistered[name] = UnregisteredView(views, estimated, sorted(others))
    with tqdm(total=len(added), desc="placing", unit="photo", disable=not options.progress) as bar:

        def on_view() -> None:
            bar.update()

        grown = grow(
            [each.model for each in working],
            unregistered,
            ResectionMatches(matches, seed),
            DeviceImages(photos.gray),
            refinement=config.refinement,
            on_view=on_view,
        )
    models = read_models(run.folder / "sparse", database)
    for k in sorted(set(grown.registered.values())):
        models[k] = grown.models[k].to_colmap()
        colour_points(models[k], photos.rgb)
    write_models(models, target / "sparse")
    sizes = {name: photos.files[name].size for name in photos.files.keys() - new.skipped.keys()}
    return extended_report(run, models, grown, new, matches, verified, sizes)
