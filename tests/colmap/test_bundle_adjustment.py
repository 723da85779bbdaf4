"""Laws of COLMAP's bundle adjustment as it is used here."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from room_scene import Room, arrays, camera, exact_model

from jaxsfm.colmap import bundle_adjustment
from jaxsfm.colmap.adjustment import adjustable
from jaxsfm.colmap.bundle_adjustment import VIEWS_FOR_CENTRE, bundle_adjust
from jaxsfm.colmap.bundle_adjustment import adjusted as adjusted_model
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.turned_cameras import adjust_as_one, shares_one_camera
from jaxsfm.core import bundle_layout
from jaxsfm.io.orientation import to_stored
from jaxsfm.sfm.evaluation import evaluate

CODES = {"0.png": 1, "1.png": 6, "2.png": 1, "3.png": 3, "4.png": 8}
OFF = 5.0
"""The principal point lies so many pixels beside the centre of the photos, along both axes."""


def diverging(room: Room, points: int):
    """The exact room, in which the rays of some points' only two observations meet behind the
    cameras. COLMAP has the points in front."""
    model = exact_model(room)
    tracks = model.tracks
    both = np.flatnonzero((room.visible[:, 0]) & (room.visible[:, 4]))[:points]
    drop = np.isin(tracks.point, both) & ~np.isin(tracks.view, [0, 4])
    xy = tracks.xy.copy()
    for point in both:
        for view, other in ((0, 4), (4, 0)):
            row = np.flatnonzero((tracks.point == point) & (tracks.view == view))[0]
            ray = model.views[other].centre - model.views[view].centre
            towards, _ = model.views[view].project((tracks.points[point] + 0.3 * ray)[None])
            xy[row] -= 3 * (towards[0] - xy[row])  # past the parallel: they meet behind
    return model.with_tracks(tracks._replace(xy=xy)).select(~drop).to_colmap()


def test_points_that_end_behind_a_camera_are_left_out(rendered):
    """COLMAP gives such a point an error of 1e154."""
    model = diverging(rendered, 5)
    before = model.num_points3D()
    bundle_adjust(model, loss_px=1000.0, refine_intrinsics=False, threads=1)
    assert before - 5 <= model.num_points3D() < before
    assert max(point.error for point in model.points3D.values()) < 1e3
    assert np.isfinite(arrays(model, rendered).errors_px()).all()


def test_an_exact_model_stays_as_it_is(rendered):
    model = exact_model(rendered).to_colmap()
    before = arrays(model, rendered)
    bundle_adjust(model, loss_px=1.0, refine_intrinsics=False, threads=1)
    after = arrays(model, rendered)
    np.testing.assert_allclose(after.tracks.points, before.tracks.points, atol=1e-6)
    assert after.errors_px().max() < 1e-4


def test_a_model_keeps_its_size_and_place_whichever_cameras_hold_the_solver(rendered):
    """The solver holds the first camera, and its distance to another one, which is wrong here."""
    model = exact_model(rendered).to_colmap()
    second = model.image(sorted(model.reg_image_ids())[1])
    pose = second.cam_from_world()
    pose.translation = pose.translation + [0.05, -0.08, 0.1]
    second.frame.set_cam_from_world(second.camera_id, pose)

    def centres() -> np.ndarray:
        numbers = sorted(model.reg_image_ids())
        return np.stack([model.image(n).projection_center() for n in numbers])

    before = centres()
    bundle_adjust(model, loss_px=1000.0, refine_intrinsics=False, threads=1)
    for place in (lambda x: np.median(x, 0), lambda x: x[3] - x[4]):
        np.testing.assert_allclose(place(centres()), place(before), atol=0.02)
    distances = [
        np.median(np.linalg.norm(x - np.median(x, axis=0), axis=1)) for x in (before, centres())
    ]
    assert distances[0] == pytest.approx(distances[1], rel=1e-9)


TRUTH = camera().params


def wrong_centres(room: Room, of_views: list[int]) -> pycolmap.Reconstruction:
    """The exact room; view k has camera `of_views[k]`, whose principal point is 6 pixels off."""
    exact = exact_model(room)
    views = []
    for view, number in zip(exact.views, of_views, strict=True):
        own = camera()
        own.camera_id = number
        views.append(dataclasses.replace(view, camera=own))
    model = Model(views, exact.tracks).to_colmap()
    for each in model.cameras.values():
        each.principal_point_x += 6.0
        each.principal_point_y -= 6.0
    return model


def adjusted(model: pycolmap.Reconstruction, *, refine_intrinsics: bool = True) -> dict[int, float]:
    """How far off each principal point is after the adjustment, pixels, by camera."""
    bundle_adjust(model, loss_px=100.0, refine_intrinsics=refine_intrinsics, threads=1)
    return {n: float(np.abs(c.params[2:] - TRUTH[2:]).max()) for n, c in model.cameras.items()}


def test_a_camera_of_many_views_finds_its_principal_point(rendered):
    assert adjusted(wrong_centres(rendered, [1] * 5))[1] < 0.1


def test_a_known_camera_keeps_its_principal_point(rendered):
    assert adjusted(wrong_centres(rendered, [1] * 5), refine_intrinsics=False) == {1: 6.0}


def test_cameras_of_few_views_keep_their_principal_points(rendered):
    off = adjusted(wrong_centres(rendered, [1] * VIEWS_FOR_CENTRE + [2, 2]))
    assert off[1] != 6.0 and off[2] == 6.0


def test_a_principal_point_that_runs_away_is_put_back(rendered, monkeypatch):
    """The photos are said to be wider, so that the right point is farther from their centre."""

    def wide() -> pycolmap.Reconstruction:
        model = wrong_centres(rendered, [1] * 5)
        model.camera(1).width += 40
        return model

    assert adjusted(wide())[1] < 0.1
    monkeypatch.setattr(bundle_adjustment, "FARTHEST_CENTRE", 0.01)
    assert adjusted(wide()) == {1: 6.0}
    assert adjusted(wrong_centres(rendered, [1] * 5))[1] < 0.1  # it comes nearer to the centre


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


@pytest.mark.parametrize("solver", ["core", "colmap"])
def test_a_camera_that_becomes_none_that_a_lens_can_be_stays_as_it_was(
    rendered, monkeypatch, solver
):
    """One view has a camera of its own, and its keypoints are mirrored: a focal length below 0 fits
    them."""
    exact = exact_model(rendered)
    views = list(exact.views)
    own = camera()
    own.camera_id = 2
    views[2] = dataclasses.replace(views[2], camera=own)
    xy = exact.tracks.xy.copy()
    rows = exact.tracks.view == 2
    xy[rows] = 2 * (np.asarray(own.params[2:]) - 0.5) - xy[rows]
    model = Model(views, exact.tracks._replace(xy=xy), {}).to_colmap()
    if solver == "colmap":
        monkeypatch.setattr(bundle_adjustment, "adjustable", lambda *_, **__: False)
    bundle_adjust(model, loss_px=1000.0, refine_intrinsics=True, threads=1)
    np.testing.assert_array_equal(model.camera(2).params, own.params)
    monkeypatch.setattr(bundle_adjustment, "_impossible", lambda *_: False)
    wrong = Model(views, exact.tracks._replace(xy=xy), {}).to_colmap()
    bundle_adjust(wrong, loss_px=1000.0, refine_intrinsics=True, threads=1)
    assert wrong.camera(2).mean_focal_length() < 0


def test_models_without_a_formed_system_and_unknown_cameras_are_left_to_colmap(
    rendered, monkeypatch
):
    model = exact_model(rendered)
    assert adjustable(model, refine_intrinsics=True)
    views = [dataclasses.replace(view, camera=full_opencv(view.camera)) for view in model.views]
    assert not adjustable(model.with_views(views), refine_intrinsics=False)
    monkeypatch.setattr(bundle_layout, "MOST_PHOTOS", 4)
    assert not adjustable(model, refine_intrinsics=False)  # five photos of one room are no band


def full_opencv(camera: pycolmap.Camera) -> pycolmap.Camera:
    params = [*camera.params, *[0.0] * 8]
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model="FULL_OPENCV",
        width=camera.width,
        height=camera.height,
        params=params,
    )


def test_a_model_of_another_camera_keeps_its_place_too(rendered):
    """COLMAP adjusts it."""
    exact = exact_model(rendered)
    views = [dataclasses.replace(view, camera=full_opencv(view.camera)) for view in exact.views]
    found = adjusted_model(
        Model(views, exact.tracks, {}), loss_px=1.0, refine_intrinsics=False, threads=1
    )
    for old, new in zip(views, found.views, strict=True):
        np.testing.assert_allclose(new.centre, old.centre, atol=1e-4)


def test_points_that_colmap_would_leave_out_are_left_out_of_arrays_too(rendered):
    """Points of one view, of two views near each other, and of all views."""
    exact = exact_model(rendered)
    views = list(exact.views)
    near = views[0].centre + 0.02 * (views[1].centre - views[0].centre)
    views[1] = dataclasses.replace(views[1], centre=near)
    tracks = exact.tracks
    some = (tracks.view < 2) | (tracks.point % 3 == 0)
    model = Model(views, exact.select(some & ((tracks.view > 0) | (tracks.point % 5 > 0))).tracks)
    by_colmap = model.numbered_colmap()[1]
    kept = model.triangulated().tracks.points
    assert 10 < len(kept) < len(tracks.points) - 10
    np.testing.assert_array_equal(
        kept,
        model.tracks.points[sorted(by_colmap.values())][
            np.isin(sorted(by_colmap), sorted(model.to_colmap().point3D_ids()))
        ],
    )
