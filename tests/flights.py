"""A drone's flight over hilly ground, exact, and its model in a frame of its own."""

from typing import NamedTuple

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import move_model
from jaxsfm.sfm.evaluation import Similarity, umeyama
from jaxsfm.sfm.georeference.georeference import views_by_name

SIZE, FOCAL = (2000, 1500), 1400.0


class Flight(NamedTuple):
    """A flight, metres east, north and up."""

    model: pycolmap.Reconstruction
    """In the frame of a mapper: turned, shifted and scaled."""
    centres: dict[str, np.ndarray]
    """float64 (3,), by the name of the photo."""
    truth: pycolmap.Reconstruction
    """The same model in metres."""

    def seen(self, point: np.ndarray) -> dict[str, np.ndarray]:
        """The pixels float64 (2,) at which photos show a point in metres, by name."""
        found = {}
        for name, view in views_by_name(self.truth).items():
            xy, _ = view.project(point[None])
            if np.isfinite(xy).all() and (xy > 0).all() and (xy < np.asarray(SIZE) - 1).all():
                found[name] = xy[0]
        return found

    def move_found(self) -> Similarity:
        """The similarity from the truth to where the model is now. It is the identity if the model
        was moved into metres exactly."""
        poses, names = model_poses(self.model), sorted(self.centres)
        now = np.asarray([poses[name].centre for name in names])
        return umeyama(np.asarray([self.centres[name] for name in names]), now)


def flight(seed: int = 0, *, rows: int = 4, columns: int = 5, flat: float = 3.0) -> Flight:
    """A flight 80 m above the ground, which looks down with small tilts.

    Args:
      flat: the standard deviation of the heights, metres.
    """
    rng = np.random.default_rng(seed)
    truth = pycolmap.Reconstruction()
    width, height = SIZE
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=width,
        height=height,
        params=[FOCAL, width / 2, height / 2],
        camera_id=1,
    )
    truth.add_camera_with_trivial_rig(camera)
    centres = {}
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        centre = np.asarray([25.0 * column, 20.0 * row, 80.0]) + rng.normal(size=3) * [1, 1, flat]
        # The camera's axes are east, south and down, then tilted.
        turn = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix() @ np.diag([1.0, -1, -1])
        image = pycolmap.Image(name=f"{k:02d}.jpg", camera_id=1, image_id=k + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ centre)
        truth.add_image_with_trivial_frame(image, pose)
        centres[image.name] = centre
    model = pycolmap.Reconstruction(truth)
    away = Rotation.random(random_state=seed).as_matrix()
    move_model(model, 0.05, away, rng.normal(size=3))
    return Flight(model, centres, truth)
