"""Laws of placing: how much doubt observations leave about a view, and octaves of an image."""

import dataclasses

import numpy as np
import pytest
from room_scene import SIZE, Room, exact_model, images_of

from jaxsfm.colmap.resection import adjust_view
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine import octave_pose
from jaxsfm.sfm.refine import pose_uncertainty as uncertainty_of_poses
from jaxsfm.sfm.refine.fixed_structure import AlignedPoints, FixedStructure
from jaxsfm.sfm.refine.octave_pose import (
    OctavePose,
    PoseHypothesis,
    follow,
    trusted,
)
from jaxsfm.sfm.refine.pose_uncertainty import pose_uncertainty, projected_uncertainty
from jaxsfm.sfm.view_graph import rotation_angle_deg

NIGHT = 2


def observed(scene: Room, rows: np.ndarray, sigma: float) -> AlignedPoints:
    """Points as the night view would show them, off by noise."""
    points = scene.points[rows]
    xy = scene.views[NIGHT].project(points)[0]
    noise = np.random.default_rng(0).normal(0, sigma, xy.shape)
    return AlignedPoints(rows, points, xy + noise, scene.points[scene.visible[:, NIGHT]])


def uncertainty_of(
    view: View, seen: AlignedPoints, error_px: float, side: float, focal=False
) -> float:
    return projected_uncertainty(
        view, seen.points, seen.xy, seen.candidates, error_px, side, focal=focal
    )


@pytest.mark.parametrize(("sigma", "focal"), [(0.3, False), (2.0, False), (0.3, True)])
def test_doubt_is_how_far_off_projections_are(rendered, sigma, focal):
    """Over many draws of the noise, where every observation has a patch of its own.

    The focal length is in doubt where observations are in a corner.
    """
    view = rendered.views[NIGHT]
    rows = np.flatnonzero(rendered.visible[:, NIGHT])
    at = view.project(rendered.points[rows])[0]
    rows = rows[(at < 200).all(1)][::3] if focal else rows[::9]
    doubts, errors = [], []
    for seed in range(40):
        noise = np.random.default_rng(seed).normal(0, sigma, (len(rows), 2))
        seen = observed(rendered, rows, 0.0)
        seen = seen._replace(xy=seen.xy + noise)
        found = adjust_view(view, seen.xy, seen.points, refine_focal_length=focal)
        assert found is not None
        off = found.project(seen.points)[0] - seen.xy
        median = float(np.median(np.linalg.norm(off, axis=1)))
        doubts.append(uncertainty_of(found, seen, median, 1, focal))
        errors.append(found.project(seen.candidates)[0] - view.project(seen.candidates)[0])
    true = np.sqrt(np.mean(np.square(errors)))
    assert 0.6 < np.median(doubts) / true < 1.3


@pytest.mark.parametrize("focal", [False, True])
def test_the_doubt_about_a_pose_is_how_far_off_it_is(rendered, focal):
    """Root mean square over many draws of the noise, of centre and rotation."""
    view = rendered.views[NIGHT]
    rows = np.flatnonzero(rendered.visible[:, NIGHT])[::9]
    points, exact = rendered.points[rows], view.project(rendered.points[rows])[0]
    doubts, errors = [], []
    for seed in range(40):
        xy = exact + np.random.default_rng(seed).normal(0, 1.0, exact.shape)
        found = adjust_view(view, xy, points, refine_focal_length=focal)
        assert found is not None
        median = float(np.median(np.linalg.norm(found.project(points)[0] - xy, axis=1)))
        doubts.append(pose_uncertainty(found, points, xy, median, 1, focal=focal))
        turn = rotation_angle_deg(found.rotation, view.rotation)
        errors.append((np.linalg.norm(found.centre - view.centre), turn))
    ratio = np.median(doubts, axis=0) / np.sqrt(np.mean(np.square(errors), axis=0))
    assert (ratio > 0.6).all() and (ratio < 1.4).all(), ratio


def test_the_doubt_about_a_pose_adds_the_variances_of_its_three_axes(rendered, monkeypatch):
    deviations = np.asarray([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) / 100  # of rotation, then of position
    monkeypatch.setattr(uncertainty_of_poses, "_covariance", lambda *_: np.diag(deviations**2))
    monkeypatch.setattr(uncertainty_of_poses, "_reach", lambda *_: 2.0)
    points = rendered.points[:10]
    found = pose_uncertainty(rendered.views[NIGHT], points, np.zeros((10, 2)), 1.0, 1, focal=False)
    assert found.rotation_deg == pytest.approx(np.degrees(np.sqrt(1 + 4 + 9) / 100))
    assert found.centre == pytest.approx(2 * np.sqrt(16 + 25 + 36) / 100)


def test_points_in_a_corner_leave_more_doubt_than_fewer_everywhere(rendered):
    rows = np.flatnonzero(rendered.visible[:, NIGHT])
    at = rendered.views[NIGHT].project(rendered.points[rows])[0]
    corner = rows[np.argsort(at @ [1.0, 1.0])[: len(rows) // 8]]
    spread = rows[:: len(rows) // 30]
    doubt = [
        uncertainty_of(rendered.views[NIGHT], observed(rendered, some, 1.0), 1.0, 1)
        for some in (corner, spread)
    ]
    assert len(spread) < len(corner) / 2 and doubt[0] > 2 * doubt[1]


def test_patches_that_overlap_count_once(rendered):
    rows = np.flatnonzero(rendered.visible[:, NIGHT])[::9]
    seen = observed(rendered, rows, 1.0)
    twice = seen._replace(points=np.repeat(seen.points, 2, 0), xy=np.repeat(seen.xy, 2, 0))
    view = rendered.views[NIGHT]
    assert uncertainty_of(view, twice, 1.0, 1) == pytest.approx(uncertainty_of(view, seen, 1.0, 1))


def test_one_point_determines_no_pose(rendered):
    seen = observed(rendered, np.full(40, np.flatnonzero(rendered.visible[:, NIGHT])[0]), 1.0)
    assert uncertainty_of(rendered.views[NIGHT], seen, 1.0, 15) == np.inf


@pytest.mark.parametrize(
    ("share", "uncertainty_px", "right"),
    [(0.06, 0.9, True), (0.04, 0.1, False), (0.5, 1.1, False), (0.5, np.inf, False)],
)
def test_a_pose_is_trusted_with_little_doubt_and_enough_that_agrees(
    rendered, share, uncertainty_px, right
):
    view = rendered.views[NIGHT]
    seen = observed(rendered, np.arange(40), 1.0)
    best = OctavePose(view, 2, seen, 40, 1.0, uncertainty_px, 30)
    pose = PoseHypothesis(view=view, own_camera=False, octaves={2: best}, share=share)
    assert trusted(pose) is (best if right else None)
    assert trusted(dataclasses.replace(pose, octaves={})) is None


def test_only_poses_that_end_in_doubt_are_followed_again_from_where_they_were_best(
    rendered, monkeypatch
):
    start, end, last = rendered.views[NIGHT], rendered.views[0], rendered.views[1]
    seen = observed(rendered, np.arange(40), 1.0)
    found = {"doubtful": 0.8, "sure": 0.3, "lost": None}
    poses = {name: PoseHypothesis(view=start, own_camera=False) for name in found}
    began = []

    def descend(moving, *_):
        names = [next(n for n, p in poses.items() if p is pose) for pose in moving]
        began.append([(name, poses[name].view) for name in names])
        for name in names:
            uncertainty_px = found[name]
            best = OctavePose(end, 2, seen, 40, 1.0, uncertainty_px, 30) if uncertainty_px else None
            poses[name].view, poses[name].octaves = last, {2: best} if best else {}

    monkeypatch.setattr(octave_pose, "_descend", descend)
    structure = FixedStructure(exact_model(rendered), images_of(rendered), Refinement())
    follow(list(poses.values()), structure)
    first, second = began
    assert [(name, view is start) for name, view in first] == [(name, True) for name in found]
    assert [(name, view is end) for name, view in second] == [("doubtful", True)]


@pytest.mark.parametrize("px", [1, 2, 8])
def test_an_octaves_pixels_are_means_and_lie_where_they_lay(rendered, px):
    model = exact_model(rendered)
    tracks, views, smaller = model.tracks, model.in_octave(px).views, model.in_octave(px).tracks
    at, _ = views[0].project(rendered.points[:50])
    whole, _ = rendered.views[0].project(rendered.points[:50])
    np.testing.assert_allclose((at + 0.5) * px - 0.5, whole)
    np.testing.assert_allclose((smaller.xy + 0.5) * px - 0.5, tracks.xy)
    image = images_of(rendered).octave(px).take("0.png")
    assert tuple(image.size.tolist()[::-1]) == views[0].size == (SIZE[0] // px, SIZE[1] // px)
    np.testing.assert_allclose(
        image.map[3, 5, 0],
        rendered.images["0.png"][3 * px : 4 * px, 5 * px : 6 * px].mean(),
        rtol=1e-5,
    )
