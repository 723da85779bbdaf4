"""The database and the models of a run that is extended by new photos."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from jaxsfm.colmap.extend_database import add_images, add_matches, copy_database
from jaxsfm.colmap.model_folders import colour_points, read_models, write_models
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.io.photos import Photos
from jaxsfm.io.store import SavedMatches
from jaxsfm.report.finished_run import FinishedRun
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.build_report import NewPhotos, extended_report
from jaxsfm.runs.working_model import CameraPrior, WorkingModel, view_without_pose
from jaxsfm.sfm.register.grow import ExtendedModel, UnregisteredView, grow

if TYPE_CHECKING:
    import pycolmap


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedExtension:
    """A finished run, and the photos that are added to it."""

    run: FinishedRun
    model: WorkingModel
    new: NewPhotos
    cameras: Mapping[str, CameraPrior]
    """The cameras that new photos start with, by name."""
    photos: Photos
    """The run's photos and the new ones."""
    matches: SavedMatches
    """The matches of the new photos with their shortlists."""
    progress: bool

    def unregistered(
        self, added: "Mapping[str, tuple[int, pycolmap.Camera]]"
    ) -> dict[str, UnregisteredView]:
        """The new photos as views without poses.

        Args:
          added: the id and the camera of each new photo in the database.
        """
        views = {}
        for name, image in self.new.images.items():
            camera, (image_id, in_database) = self.cameras[name], added[name]
            view = dataclasses.replace(
                view_without_pose(image, camera, self.model.config),
                image_id=image_id,
                # The model has the run's camera refined; the database has it as it was before.
                camera=camera.camera if camera.source == "run" else in_database,
            )
            others = {other for pair in self.matches if name in pair for other in pair} - {name}
            views[name] = UnregisteredView(view, camera.estimated, sorted(others))
        return views

    def models(self, database: Path, grown: ExtendedModel) -> "list[pycolmap.Reconstruction]":
        """The models of the run, of which the best one has grown."""
        models = read_models(self.run.folder / "sparse", database)
        if grown.placed:
            models[0] = grown.model.to_colmap()
            colour_points(models[0], self.photos.rgb)
        return models


def write_extension(extension: PlannedExtension, target: Path) -> RunReport:
    """Register the new photos, and write the database and the models into `target`.

    Returns:
      The report of the extended run.
    """
    run, model, new, photos = extension.run, extension.model, extension.new, extension.photos
    matches, database = extension.matches, target / "database.db"
    count = sum(result.num_inliers for result in matches.values())
    copy_database(run.folder / "database.db", database, count)
    cameras = {n: (image, extension.cameras[n].camera) for n, image in new.images.items()}
    added = add_images(database, cameras)
    verified = add_matches(
        database,
        matches,
        VerificationOptions(
            seed=model.seed,
            threads=run.report.options.threads,
            scale=photos.median_scale(),
        ),
    )
    unregistered = extension.unregistered(added)
    quiet = not extension.progress
    with tqdm(total=len(unregistered), desc="placing", unit="photo", disable=quiet) as bar:

        def on_view() -> None:
            bar.update()

        grown = grow(
            model.model,
            unregistered,
            matches,
            photos.gray,
            refinement=model.config.refinement,
            seed=model.seed,
            on_view=on_view,
        )
    models = extension.models(database, grown)
    write_models(models, target / "sparse")
    sizes = {name: photos.files[name].size for name in photos.files.keys() - new.skipped.keys()}
    return extended_report(run, models, grown, new, matches, verified, sizes)
