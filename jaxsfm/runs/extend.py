"""A finished run extended by photos that were added to its folder since.

They are matched with their shortlists alone, placed into the model, whose poses and points stay as
they are, and add points of their own (`jaxsfm.sfm.register.grow`).
Matches are kept as a run's are, so a later reconstruct of the folder goes on from them.
"""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from jaxsfm.colmap.extend_database import add_images, add_matches, copy_database
from jaxsfm.colmap.intrinsics import parse_intrinsics
from jaxsfm.colmap.model_arrays import build_model
from jaxsfm.colmap.models import colour_points, read_models, write_models
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import SavedMatches
from jaxsfm.io.versions import versions
from jaxsfm.io.work_folder import RECORD, WorkFolder, locked, locked_folder
from jaxsfm.matching.pipeline import open_images
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.page.after_run import page_after_run
from jaxsfm.report.run_report import RunReport, write_report
from jaxsfm.runs.compute_missing import extract_missing, match_missing
from jaxsfm.runs.finished_model import (
    ChosenCamera,
    KnownModel,
    choose_camera,
    known_model,
    run_files,
    run_weights,
    view_of,
)
from jaxsfm.runs.localize import LocalizeOptions
from jaxsfm.runs.report import NewPhotos, extended_report
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.register.grow import Grown, Newcomer, grow

if TYPE_CHECKING:
    import pycolmap


def extend(run: Path, *, options: LocalizeOptions) -> dict[str, object] | None:
    """Extend a finished run; returns the content of its new report.json, or None.

    See `extend_run`, which returns the report as an object.
    """
    report = extend_run(run, options=options)
    return None if report is None else report.to_json()


def extend_run(run: Path, *, options: LocalizeOptions) -> RunReport | None:
    """Extend a finished run; returns its new report, or None if there are no new photos, not even
    broken ones.

    `report.extended` has a row for every extension: when, which photos were added, which placed,
    which skipped.

    Args:
      run: a run's OUT.

    Raises:
      UserError: no finished run with a model, or its photos or weights are not at hand.
    """
    if not (run / RECORD).exists():
        raise UserError(f"{run}: no finished run here ({RECORD} is missing)")
    with locked(run):  # before anything is read: another one may be publishing
        return _extend(run, options)


def _extend(run: Path, options: LocalizeOptions) -> RunReport | None:
    start = time.monotonic()
    kept = read_run(run, images=options.images, reference=options.reference)
    if kept.model is None:
        raise UserError(f"{run}: this run has no model to extend")
    if kept.photos.folder is None:
        raise UserError(f"{run}: where its photos lie is not known; say it with --images")
    config, weights = kept.config, run_weights(kept, options.network)
    identity = kept.report.identity
    if identity.version != versions()["jaxsfm"]:
        raise UserError(
            f"{run}: was made by jaxsfm {identity.version}, this is {versions()['jaxsfm']}; "
            "run reconstruct again"
        )
    usable, broken = open_images(kept.photos.folder, progress=options.progress)
    old, skipped = identity.images, kept.report.images.skipped
    used = old.keys() - skipped.keys()
    # A photo that was skipped is new once it is another file, or if it was not for damage.
    fresh = [i for i in usable if i.name not in used and not kept.matches.why_unusable(i)]
    new = {image.name: image for image in fresh}
    newly_broken = {n: why for n, why in broken.items() if n not in used and n not in skipped}
    if not new and not newly_broken:
        return None
    model = known_model(run / "sparse" / "0", config, seed=kept.report.options.seed)
    names = [view.name for view in model.views]
    there = {i.name: i for i in usable if i.name in used and old[i.name] == i.sha256}
    run_files(kept, [name for name in names if name not in there])  # says what is gone
    files = there | new
    intrinsics = parse_intrinsics(options.intrinsics) if options.intrinsics else None
    cameras = {name: choose_camera(i, model.views, intrinsics) for name, i in new.items()}
    hashes = old | {name: image.sha256 for name, image in new.items()}
    identity = dataclasses.replace(identity, images=hashes)
    run_options = RunOptions(
        seed=model.seed,
        network=options.network,
        execution=options.execution,
        progress=options.progress,
    )
    folder = locked_folder(run, identity.to_json())
    shortlist = options.chosen_shortlist(kept, weights, new)
    shortlists, unread = {}, {}
    for name, image in new.items():
        try:
            others = [n for n in sorted([*names, *new]) if n != name]
            shortlists[name] = shortlist(image, others)
        except ImageError as error:
            unread[name] = str(error)
            folder.note_failure(image, error)
    pairs = sorted({make_pair(a, b) for a, others in shortlists.items() for b in others})
    missing = [pair for pair in pairs if folder.load_matches(pair) is None]
    undecoded = unread | extract_missing(folder, weights, files, missing, config, run_options)
    if old_lost := undecoded.keys() & set(names):
        raise UserError(undecoded[min(old_lost)])
    new = {name: image for name, image in new.items() if name not in undecoded}
    pairs = [pair for pair in pairs if not undecoded.keys() & set(pair)]
    missing = [pair for pair in missing if not undecoded.keys() & set(pair)]
    for _ in match_missing(folder, weights, files, missing, config, run_options):
        pass
    added = NewPhotos(new, newly_broken | undecoded)
    with folder.publish() as target:
        report = _extended(kept, folder, target, model, added, cameras, pairs, files, options)
        took = report.seconds.get("extension", 0.0) + time.monotonic() - start
        seconds = report.seconds | {"extension": took}
        report = dataclasses.replace(report, identity=identity, seconds=seconds)
        write_report(target, report)
    if not options.keep_features:
        folder.drop_features()
    page_after_run(run)
    return report


def _extended(
    kept: FinishedRun,
    folder: WorkFolder,
    fresh: Path,
    model: KnownModel,
    new: NewPhotos,
    cameras: Mapping[str, ChosenCamera],
    pairs: list[Pair],
    files: Mapping[str, ImageFile],
    options: LocalizeOptions,
) -> RunReport:
    """Write the database and the models into `fresh`; returns the report."""
    home, config = folder.path, model.config
    matches = SavedMatches(folder, pairs)
    chosen = {name: cameras[name] for name in new.images}
    database = fresh / "database.db"
    count = sum(result.num_inliers for result in matches.values())
    copy_database(home / "database.db", database, count)
    added = add_images(database, {n: (new.images[n], chosen[n].camera) for n in chosen})
    verified = add_matches(
        database,
        matches,
        seed=model.seed,
        threads=kept.report.options.threads,
        scale=Photos(files.values(), config).median_scale(),
    )
    newcomers = {
        name: Newcomer(
            dataclasses.replace(
                view_of(image, chosen[name], config),
                image_id=added[name][0],
                # The run's camera as the model has it: the database knows it unrefined.
                camera=chosen[name].camera if chosen[name].source == "run" else added[name][1],
            ),
            chosen[name].own,
            sorted({other for pair in pairs if name in pair for other in pair} - {name}),
        )
        for name, image in new.images.items()
    }
    quiet = not options.progress
    with tqdm(total=len(newcomers), desc="placing", unit="photo", disable=quiet) as bar:

        def on_view() -> None:
            bar.update()

        grown = grow(
            model.views,
            model.tracks,
            newcomers,
            matches,
            Photos(files.values(), config).gray,
            refinement=config.refinement,
            seed=model.seed,
            on_view=on_view,
        )
    models = _models(home, database, grown, files, model)
    write_models(models, fresh / "sparse")
    sizes = {name: files[name].size for name in files.keys() - new.skipped.keys()}
    return extended_report(kept, models, grown, new, matches, verified, sizes)


def _models(
    home: Path,
    database: Path,
    grown: Grown,
    files: Mapping[str, ImageFile],
    model: KnownModel,
) -> "list[pycolmap.Reconstruction]":
    """The run's models, the best one grown."""
    models = read_models(home / "sparse", database)
    if grown.placed:
        models[0] = build_model(models[0], grown.views, grown.tracks)
        colour_points(models[0], Photos(files.values(), model.config).rgb)
    return models
