"""Where a refined model of another tool lies, and at which size its alignment starts."""

import numpy as np
import pytest
from room_scene import SIZE, noisy_model

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.colmap.reconstruction import move_model
from jaxsfm.sfm.given_refinement import _described_px, move_back


class Photos:
    """Photos that are all reduced alike."""

    def __init__(self, scale: float) -> None:
        self.scale = scale

    def gray(self, name):
        width, height = (round(side / self.scale) for side in SIZE)
        return np.zeros((height, width), np.float32), (self.scale, self.scale)


def test_a_corrected_camera_does_not_move_the_others(rendered):
    """Whatever similarity the adjustment added, the cameras return to their places."""
    model = noisy_model(rendered, 0.0)
    truth = model_poses(model)
    wrong = truth["4.png"]
    before = truth | {"4.png": CameraPose(wrong.rotation, wrong.centre + [0.5, -0.2, 0.3])}
    turn = np.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    move_model(model, 1.3, turn, np.asarray([1.0, 2.0, 3.0]))
    move_back(model, before)
    after = model_poses(model)
    for name, pose in truth.items():
        np.testing.assert_allclose(after[name].centre, pose.centre, atol=1e-9)
        np.testing.assert_allclose(after[name].rotation, pose.rotation, atol=1e-9)


def test_two_cameras_stay_where_the_adjustment_put_them(rendered):
    sizes = {view.name: (SIZE, (1.0, 1.0)) for view in rendered.views}
    whole = Model.from_colmap(noisy_model(rendered, 0.0), sizes)
    model = whole.part({"0.png", "1.png"})[0].to_colmap()
    before = model_poses(model)
    move_back(model, {name: pose._replace(centre=2 * pose.centre) for name, pose in before.items()})
    for name, pose in model_poses(model).items():
        np.testing.assert_allclose(pose.centre, before[name].centre, atol=1e-12)


@pytest.mark.parametrize(
    ("sigma", "scale", "wanted"), [(0.3, 1.0, 1), (1.5, 1.0, 2), (1.5, 3.0, 1), (60.0, 1.0, 8)]
)
def test_the_alignment_starts_where_a_pixel_is_as_large_as_the_error(
    rendered, sigma, scale, wanted
):
    """Errors are counted in working pixels, and an eighth of the working size is the least."""
    model = noisy_model(rendered, 0.0)
    exact = Model.from_colmap(model, {v.name: (SIZE, (1.0, 1.0)) for v in rendered.views})
    noise = np.random.default_rng(0).normal(0, sigma, exact.tracks.xy.shape)
    given = exact.with_tracks(exact.tracks._replace(xy=exact.tracks.xy + noise)).to_colmap()
    assert _described_px(given, Photos(scale)) == wanted  # pyright: ignore[reportArgumentType]
