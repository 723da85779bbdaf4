"""The database and the models of a run that is extended by new photos."""

import dataclasses
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.extend_database import add_images, add_matches, copy_database
from jaxsfm.colmap.model_folders import colour_points, read_models, write_models
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.io.looks import SavedMatches
from jaxsfm.io.photos import Photos
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.build_report import NewPhotos, extended_report
from jaxsfm.runs.working_model import WorkingModel, view_without_pose
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.register.grow import UnregisteredView, grow


def write_extension(
    target: Path,
    run: FinishedRun,
    model: WorkingModel,
    new: NewPhotos,
    photos: Photos,
    matches: SavedMatches,
    *,
    progress: bool,
) -> RunReport:
    """Register the new photos, and write the database and the models into `target`.

    Args:
      photos: the run's photos and the new ones.
      matches: the matches of the new photos with their shortlists.
    """
    database = target / "database.db"
    count = sum(result.num_inliers for result in matches.values())
    copy_database(run.folder / "database.db", database, count)
    added = add_images(database, {n: (i, new.cameras[n].camera) for n, i in new.images.items()})
    options = VerificationOptions(
        seed=model.seed, threads=run.report.options.threads, scale=photos.median_scale()
    )
    verified = add_matches(database, matches, options)
    unregistered = {}
    for name, (image_id, in_database) in added.items():
        prior = new.cameras[name]
        view = dataclasses.replace(
            view_without_pose(new.images[name], prior, model.config),
            image_id=image_id,
            # The model has the run's camera refined; the database has it as it was before.
            camera=prior.camera if prior.source == "run" else in_database,
        )
        others = {other for pair in matches if name in pair for other in pair} - {name}
        unregistered[name] = UnregisteredView(view, prior.estimated, sorted(others))
    with tqdm(total=len(added), desc="placing", unit="photo", disable=not progress) as bar:

        def on_view() -> None:
            bar.update()

        grown = grow(
            model.model,
            unregistered,
            matches,
            DeviceImages(photos.gray),
            refinement=model.config.refinement,
            seed=model.seed,
            on_view=on_view,
        )
    models = read_models(run.folder / "sparse", database)
    if grown.placed:
        models[0] = grown.model.to_colmap()
        colour_points(models[0], photos.rgb)
    write_models(models, target / "sparse")
    sizes = {name: photos.files[name].size for name in photos.files.keys() - new.skipped.keys()}
    return extended_report(run, models, grown, new, matches, verified, sizes)
