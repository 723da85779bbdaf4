"""The database and the models of a run that is extended by new photos."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.extend_database import add_images, add_matches, copy_database
from jaxsfm.colmap.model_folders import colour_points, read_models, write_models
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import SavedMatches
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.build_report import NewPhotos, extended_report
from jaxsfm.runs.run_options import LocalizeOptions
from jaxsfm.runs.working_model import WorkingModel, view_without_pose
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.register.grow import UnregisteredView, grow


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
    database = target / "database.db"
    count = sum(result.num_inliers for result in matches.values())
    copy_database(run.folder / "database.db", database, count)
    # A camera of the run has the same number in all models, and a new one has none yet.
    added = add_images(database, {n: (i, new.cameras[n][0].camera) for n, i in new.images.items()})
    seed, config = run.report.options.seed, run.config
    verification = VerificationOptions(
        seed=seed, threads=options.threads, scale=photos.median_scale()
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
            matches,
            DeviceImages(photos.gray),
            refinement=config.refinement,
            seed=seed,
            on_view=on_view,
        )
    models = read_models(run.folder / "sparse", database)
    for k in sorted(set(grown.placed.values())):
        models[k] = grown.models[k].to_colmap()
        colour_points(models[k], photos.rgb)
    write_models(models, target / "sparse")
    sizes = {name: photos.files[name].size for name in photos.files.keys() - new.skipped.keys()}
    return extended_report(run, models, grown, new, matches, verified, sizes)
