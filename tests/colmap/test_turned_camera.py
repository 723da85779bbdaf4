"""One camera of photos whose pixels were turned."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from room_scene import Room, camera, exact_model

from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.turned_camera import adjust_as_one, shares_one_camera
from jaxsfm.io.orientation import to_stored
from jaxsfm.sfm.evaluation import evaluate

CODES = {"0.png": 1, "1.png": 6, "2.png": 1, "3.png": 3, "4.png": 8}
OFF = 5.0
"""The principal point lies so many pixels beside the centre of the photos, along both axes."""


def turned_room(room: Room) -> tuple[pycolmap.Reconstruction, dict[str, pycolmap.Camera]]:
    """The exact room, stored turned, with guessed principal points; and the right cameras."""
    exact, views, right = exact_model(room), [], {}
    params = np.asarray(camera().params)
    known = Intrinsics(model="PINHOLE", params=(*params[:2], *(params[2:] + OFF)))
    tracks = exact.tracks
    xy = tracks.xy + OFF  # what the camera with this principal point sees
    for k, view in enumerate(exact.views):
        code = CODES[view.name]
        size = view.size if code in (1, 3) else view.size[::-1]
        matrix, axes = to_stored(size, code), np.eye(3)
        axes[:2, :2] = matrix[:2, :2]
        right[view.name] = known.turned(size, code).camera(size)
        guess = known.turned(size, code).camera(size)
        guess.principal_point_x, guess.principal_point_y = size[0] / 2, size[1] / 2
        guess.camera_id = right[view.name].camera_id = code
        own = tracks.view == k
        xy[own] = xy[own] @ matrix[:2, :2].T + matrix[:2, 2]
        views.append(
            dataclasses.replace(view, rotation=axes @ view.rotation, camera=guess, size=size)
        )
    return Model(views, tracks._replace(xy=xy)).to_colmap(), right


def test_all_photos_determine_the_camera_together(rendered):
    model, right = turned_room(rendered)
    assert shares_one_camera(model, CODES)
    for _ in range(2):
        model = adjust_as_one(model, CODES, threads=1)
    truth = dict(rendered.poses)
    for image in model.images.values():
        found = model.camera(image.camera_id)
        assert image.camera_id == CODES[image.name]
        assert (found.width, found.height) == (right[image.name].width, right[image.name].height)
        np.testing.assert_allclose(found.params, right[image.name].params, atol=0.1)
        axes = np.eye(3)
        axes[:2, :2] = to_stored((1, 1), CODES[image.name])[:2, :2]
        truth[image.name] = truth[image.name]._replace(rotation=axes @ truth[image.name].rotation)
    errors = evaluate(model_poses(model), truth)
    assert errors.position["max"] < 1e-3 and errors.rotation_deg["max"] < 0.02
    assert model.compute_mean_reprojection_error() < 0.02


@pytest.mark.parametrize(
    ("codes", "own", "shared"),
    [
        (CODES, {}, True),
        (dict.fromkeys(CODES, 1), {}, False),  # nothing was turned
        (CODES, {"2.png": 9}, False),  # two photos that were turned alike have two cameras
        (CODES | {"3.png": 4}, {}, False),  # a mirrored photo
    ],
    ids=["turned", "not turned", "two cameras", "mirrored"],
)
def test_what_counts_as_one_camera(rendered, codes, own, shared):
    exact = exact_model(rendered)
    views = []
    for view in exact.views:
        each = camera()
        each.camera_id = own.get(view.name, codes[view.name])
        views.append(dataclasses.replace(view, camera=each))
    assert shares_one_camera(exact.with_views(views).to_colmap(), codes) == shared
