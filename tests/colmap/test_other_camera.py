"""Laws of the question whether photos speak for another camera than the one that was held."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from room_scene import Room, camera, exact_model, exact_tracks, view_of

from jaxsfm.colmap import other_camera as module
from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.other_camera import OTHER, camera_distance, other_camera

TRUTH = camera()
LIMIT_PX = OTHER * max(TRUTH.width, TRUTH.height)


def held_with(room: Room, factor: float, *, noise_px: float = 0.0, of_views=(1,) * 5):
    """A model of the room that was adjusted with a camera whose focal lengths are off by a factor.

    View k has camera `of_views[k]`.
    """
    exact = exact_model(room)
    noise = np.random.default_rng(0).normal(0, noise_px, exact.tracks.xy.shape)
    views = []
    for view, number in zip(exact.views, of_views, strict=True):
        own = camera()
        own.camera_id = number
        views.append(dataclasses.replace(view, camera=own))
    tracks = exact.tracks._replace(xy=exact.tracks.xy + noise)
    model = Model(views, tracks).to_colmap()
    for each in model.cameras.values():
        each.params = [*(factor * np.asarray(each.params[:2])), *each.params[2:]]
    bundle_adjust(model, loss_px=1.0, refine_intrinsics=False, threads=1)
    return model


def test_photos_speak_for_the_camera_that_took_them(rendered):
    found = other_camera(held_with(rendered, 1.03, noise_px=0.1), threads=1)
    assert found is not None and found.model == "OPENCV"
    np.testing.assert_allclose(found.params[:4], TRUTH.params, atol=2.0)
    assert found.distance_px > 10 * found.halves_px
    given = parse_intrinsics(found.as_option()).camera(SIZE)
    assert camera_distance(given, TRUTH) < LIMIT_PX
    assert found.as_option() in found.in_words()


SIZE = (TRUTH.width, TRUTH.height)


def test_photos_do_not_speak_against_their_own_camera(rendered):
    assert other_camera(held_with(rendered, 1.0, noise_px=0.1), threads=1) is None


def test_halves_that_do_not_agree_speak_for_no_camera(rendered, monkeypatch):
    """With so much noise the halves find cameras of their own."""
    noisy = held_with(rendered, 1.0, noise_px=3.0)
    assert other_camera(noisy, threads=1) is None
    monkeypatch.setattr(module, "AGREEMENT", 0.0)
    assert other_camera(noisy, threads=1) is not None


def test_the_model_is_not_changed(rendered):
    model = held_with(rendered, 1.03)
    points, params = model.num_points3D(), model.camera(1).params.copy()
    assert other_camera(model, threads=1) is not None
    assert model.num_points3D() == points and model.camera(1).model_name == "PINHOLE"
    np.testing.assert_array_equal(model.camera(1).params, params)


def test_a_camera_that_has_distortion_keeps_its_model(rendered):
    model = held_with(rendered, 1.03)
    fx, fy, cx, cy = model.camera(1).params
    model.camera(1).model = pycolmap.CameraModelId.FULL_OPENCV
    model.camera(1).params = [fx, fy, cx, cy, *[0.0] * 8]
    found = other_camera(model, threads=1)
    assert found is not None and found.model == "FULL_OPENCV"


@pytest.mark.parametrize("of_views", [(1, 1, 1, 2, 2), (1, 2, 3, 4, 5)])
def test_several_cameras_are_not_looked_at(rendered, of_views):
    assert other_camera(held_with(rendered, 1.03, of_views=of_views), threads=1) is None


def test_two_photos_determine_no_camera(rendered):
    use = rendered.visible.copy()
    use[:, 2:] = False
    model = Model(
        [view_of(rendered.poses[view.name], k) for k, view in enumerate(rendered.views)],
        exact_tracks(rendered, use=use),
    ).to_colmap()
    for number in sorted(model.reg_image_ids())[2:]:
        model.deregister_frame(model.image(number).frame_id)
    model.camera(1).params = [*(1.1 * TRUTH.params[:2]), *TRUTH.params[2:]]
    assert other_camera(model, threads=1) is None


def test_a_rotation_is_no_distance():
    """A principal point that moves a little is nearly a rotation."""
    moved = camera()
    moved.principal_point_x += 2.0
    assert camera_distance(TRUTH, TRUTH) == pytest.approx(0.0, abs=1e-9)
    assert camera_distance(TRUTH, moved) < 0.3
    longer = camera()
    longer.params = [*(1.01 * np.asarray(longer.params[:2])), *longer.params[2:]]
    corner = np.hypot(TRUTH.width, TRUTH.height) / 2
    assert 0.003 * corner < camera_distance(TRUTH, longer) < 0.01 * corner


def folding() -> pycolmap.Camera:
    """A camera whose distortion folds: it sees no direction at the corners of a photo."""
    lens = pycolmap.Camera(camera_id=1, model="OPENCV", width=SIZE[0], height=SIZE[1])
    lens.params = [*TRUTH.params, -2.0, 0.0, 0.0, 0.0]
    corner = np.asarray(lens.cam_from_img(np.zeros((1, 2))))
    assert not np.isfinite(corner).all()
    return lens


def test_a_camera_whose_distortion_folds_is_infinitely_far_from_any_other():
    lens = folding()
    assert camera_distance(lens, TRUTH) == camera_distance(TRUTH, lens) == np.inf
    assert camera_distance(lens, lens) == np.inf


@pytest.mark.parametrize("which", [0, 1])
def test_photos_speak_for_no_camera_whose_distortion_folds(rendered, monkeypatch, which):
    """An adjustment can leave what a lens can be, of one half of the points or of both."""
    halves = [camera(), camera()]
    for half in halves:
        half.model, half.params = pycolmap.CameraModelId.OPENCV, [*TRUTH.params, *[0.0] * 4]
    halves[which] = folding()
    models = [SimpleNamespace(cameras={1: half}) for half in halves]
    monkeypatch.setattr(module, "_half", lambda model, part: models[part])
    monkeypatch.setattr(module, "bundle_adjust", lambda *_, **__: None)
    assert other_camera(held_with(rendered, 1.03), threads=1) is None
