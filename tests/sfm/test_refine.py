"""Multi-view refinement against exact cameras, planes and pixels of a rendered room."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from room_scene import (
    SIZE,
    arrays,
    errors,
    exact_model,
    exact_tracks,
    hidden,
    noisy_model,
    other_scene,
    read_of,
    refine,
    settings_of,
    view_of,
)

from jaxsfm.bench.synthetic import arc, camera_matrix, room
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import part_of, registered
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.config import Refinement
from jaxsfm.io.photos import Pixels
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.refine import passes, plane_geometry
from jaxsfm.sfm.refine.candidates import plane_affines
from jaxsfm.sfm.refine.one_pass import run_pass
from jaxsfm.sfm.refine.passes import refine_model
from jaxsfm.sfm.refine.track_alignment import neighbourhoods

# -- the whole refinement --------------------------------------------------------------------------


def test_noisy_keypoints_end_near_the_exact_cameras(rendered):
    """One pixel of noise on every keypoint; the poses come closer to the truth by three times."""
    before = noisy_model(rendered, 1.0)
    after, figures = refine(before, rendered)
    (p0, r0), (p1, r1) = errors(before, rendered), errors(after, rendered)
    assert p1 < p0 / 3 and r1 < r0 / 3
    assert after.compute_mean_reprojection_error() < 0.3
    assert before.compute_mean_reprojection_error() > 0.9  # its own model was not touched
    assert len(figures.passes) == 2 and figures.passes[0].kept > 0.5 * rendered.visible.sum()


def test_gain_and_offset_of_a_view_change_little(rendered):
    dark = {"1.png": 0.3, "3.png": 0.6}
    model = noisy_model(rendered, 1.0)
    plain, _ = refine(model, rendered)
    images = {n: dark.get(n, 1.0) * i + 12 for n, i in rendered.images.items()}
    other, _ = refine(model, rendered._replace(images=images))
    np.testing.assert_allclose(errors(other, rendered), errors(plain, rendered), atol=3e-3)


def test_lost_observations_come_back_and_hidden_ones_do_not(rendered):
    """Tracks of two views grow to the views that show the point, and to no others."""
    use = np.zeros_like(rendered.visible)
    for row, seen in zip(use, rendered.visible, strict=True):
        row[np.flatnonzero(seen)[:2]] = True
    before = noisy_model(rendered, 0.3, use=use)
    after, figures = refine(before, rendered)
    assert sum(f.added for f in figures.passes) > 500
    assert after.compute_mean_track_length() > 1.5 * before.compute_mean_track_length()
    model = arrays(after, rendered)
    views, tracks = model.views, model.tracks
    # After alignment to the truth every point lies on its plane: find the plane, ask who hides it.
    planes = room()
    wrong = 0
    aligned = np.asarray([v.centre for v in views])
    truth = np.asarray([rendered.poses[v.name].centre for v in views])
    from jaxsfm.sfm.evaluation import umeyama

    sim = umeyama(aligned, truth)
    points = sim.scale * tracks.points @ sim.rotation.T + sim.translation
    distance = np.stack(
        [
            np.abs((points - p.corner) @ np.cross(p.right, p.down))
            / np.linalg.norm(np.cross(p.right, p.down))
            for p in planes
        ]
    )
    own = distance.argmin(0)
    for k, view in enumerate(views):
        rows = tracks.point[tracks.view == k]
        wrong += hidden(points[rows], own[rows], truth[k], planes).sum()
        assert view.name == rendered.views[k].name
    assert wrong < 0.02 * len(tracks.xy)


def test_flat_photos_leave_the_model_as_it_was(rendered):
    before = noisy_model(rendered, 1.0)
    after, figures = refine(before, rendered, lambda image: np.full_like(image, 80.0))
    assert [f.accepted for f in figures.passes] == [False]
    assert errors(after, rendered) == errors(before, rendered)
    assert after.num_points3D() == before.num_points3D()


def test_a_view_that_agrees_with_nothing_keeps_its_observations_in_the_passes(rendered):
    """As a photo by deep night: without its old keypoints it would hang on a handful."""
    before = noisy_model(rendered, 0.7)
    images = rendered.images | {"2.png": other_scene(0)}
    after, figures = refine(before, rendered._replace(images=images), weak_octaves=0)
    assert all(f.accepted and f.weak_views == ["2.png"] for f in figures.passes)
    errs = [evaluate(model_poses(m), rendered.poses).images for m in (before, after)]
    assert errs[1]["2.png"].position < 2 * errs[0]["2.png"].position + 0.002
    others = [np.mean([e.position for n, e in es.items() if n != "2.png"]) for es in errs]
    assert others[1] < others[0]
    assert (arrays(after, rendered).tracks.view == 2).sum() > 100


def test_a_view_that_is_weak_in_one_pass_is_placed(rendered, monkeypatch):
    """The few observations that agree in the first are most of what it has in the second."""
    import jaxsfm.sfm.refine.one_pass as module

    gather, calls = module._gather, []

    def weak_once(*arguments):
        calls.append(1)
        return gather(*arguments)[0], np.asarray([2] if len(calls) == 1 else [], int)

    monkeypatch.setattr(module, "_gather", weak_once)
    _, figures = refine(noisy_model(rendered, 0.7), rendered)
    assert [f.weak_views for f in figures.passes] == [["2.png"], []]
    assert [p.name for p in figures.registrations] == ["2.png"] and figures.registrations[
        0
    ].octave_px


def test_photos_that_agree_in_nothing_leave_the_model_as_it_was(rendered):
    before = noisy_model(rendered, 1.0)
    images = {name: other_scene(k) for k, name in enumerate(rendered.images)}
    after, figures = refine(before, rendered._replace(images=images))
    assert not figures.passes[-1].accepted and errors(after, rendered) == errors(before, rendered)


def test_a_pass_that_loses_most_points_is_taken_back(rendered, monkeypatch):
    from jaxsfm.sfm.refine import one_pass

    adjust = one_pass._adjust

    def loses(*arguments):
        reconstruction, model = adjust(*arguments)
        for point in list(reconstruction.point3D_ids())[25:]:
            reconstruction.delete_point3D(point)
        return one_pass.Refined(reconstruction, model)

    monkeypatch.setattr(one_pass, "_adjust", loses)
    before = noisy_model(rendered, 1.0)
    after, figures = refine(before, rendered)
    assert [f.accepted for f in figures.passes] == [False]
    assert after.num_points3D() == before.num_points3D() > 50
    assert errors(after, rendered) == errors(before, rendered)


def test_all_points_return_before_the_last_pass(rendered):
    """The mapper's model has a sixth of the points."""
    whole = noisy_model(rendered, 0.7)
    use = rendered.visible & (np.arange(len(rendered.points)) % 6 == 0)[:, None]
    few = noisy_model(rendered, 0.7, use=use)
    asked = []

    def with_all_points(model):
        asked.append(model)
        moved = dict(model_poses(model))
        tracks = arrays(whole, rendered).tracks
        views = [
            dataclasses.replace(v, rotation=moved[v.name].rotation, centre=moved[v.name].centre)
            for v in rendered.views
        ]
        return Model(views, tracks).to_colmap()

    after, figures = refine_model(
        few,
        read_of(rendered),
        settings_of(),
        with_all_points=with_all_points,
    )
    (between,) = asked
    assert between.num_points3D() < 0.3 * whole.num_points3D() < 0.35 * after.num_points3D()
    assert [f.points for f in figures.passes] == [between.num_points3D(), after.num_points3D()]
    assert max(errors(between, rendered)) < 0.5 * max(errors(few, rendered))
    assert max(errors(after, rendered)) < 0.5 * max(errors(few, rendered))


@pytest.mark.parametrize("returned", [False, True])
def test_keypoints_may_move_less_in_later_passes_unless_new_points_have_come(
    rendered, returned, monkeypatch
):
    seen = []

    def recorded(before, images, px, limits, settings):
        seen.append(limits.max_shift_px)
        return run_pass(before, images, px, limits, settings)

    monkeypatch.setattr(passes, "run_pass", recorded)
    refine_model(
        noisy_model(rendered, 0.7),
        read_of(rendered),
        settings_of(passes=3, max_shift_px=4.0),
        with_all_points=(lambda model: model) if returned else None,
    )
    assert seen == [4.0, 2.0, 4.0 if returned else 2.0]


@pytest.mark.parametrize(
    ("described_px", "sizes"), [(1, [1, 1]), (2, [2, 2, 1]), (4, [4, 4, 2, 1])]
)
def test_passes_begin_at_the_size_of_the_descriptions(rendered, described_px, sizes, monkeypatch):
    """The points return before the last of the two passes at this size."""
    seen, returned = [], []

    def recorded(before, images, px, limits, settings):
        seen.append((px, limits.max_shift_px))
        return run_pass(before, images, px, limits, settings)

    def with_all_points(model):
        returned.append(len(seen))
        return model

    monkeypatch.setattr(passes, "run_pass", recorded)
    refine_model(
        noisy_model(rendered, 0.7),
        read_of(rendered),
        settings_of(),
        with_all_points=with_all_points,
        described_px=described_px,
    )
    assert [px for px, _ in seen] == sizes and returned == [1]
    assert [shift for _, shift in seen] == [4.0, 4.0, *[2.0] * (len(sizes) - 2)]


def test_keypoints_that_are_too_far_off_for_full_size_are_aligned_from_half_of_it(rendered):
    """With a noise of 6 px, most are further off than the 4 px within which full size looks."""
    before = noisy_model(rendered, 6.0)
    given = before, read_of(rendered), settings_of()
    once, _ = refine_model(*given)
    twice, _ = refine_model(*given, described_px=2)
    assert max(errors(twice, rendered)) < 0.02
    seen = [arrays(model, rendered).tracks for model in (once, twice)]
    assert len(seen[1].view) > 1.1 * len(seen[0].view)


def test_all_points_return_if_the_passes_end_early(rendered):
    few = noisy_model(rendered, 1.0)
    images = {name: other_scene(k) for k, name in enumerate(rendered.images)}
    after, figures = refine_model(
        few,
        read_of(rendered._replace(images=images)),
        settings_of(),
        with_all_points=lambda model: part_of(model, ["0.png", "1.png", "2.png"]),
    )
    assert len(figures.passes) == 1 and len(registered(after)) == 3 < len(registered(few))


def testworking_sizes_are_widths_and_heights(rendered):
    from jaxsfm.sfm.refine.passes import working_sizes

    def read(name):
        return np.zeros((30, 40), np.float32), (2.0, 2.5)

    sizes = working_sizes(noisy_model(rendered, 1.0), read)
    assert set(sizes.values()) == {((40, 30), (2.0, 2.5))}


def test_blocks_of_points_change_nothing(rendered, monkeypatch):
    from jaxsfm.sfm.refine import track_alignment as module

    model = noisy_model(rendered, 1.0)
    whole = refine(model, rendered, passes=1)
    monkeypatch.setattr(module, "CELLS", 0)
    monkeypatch.setattr(module, "MIN_BLOCK", 100)
    parts = refine(model, rendered, passes=1)
    assert whole[1] == parts[1] and errors(whole[0], rendered) == errors(parts[0], rendered)


def test_points_in_order_of_neighbourhoods_are_seen_by_few_views_at_a_time():
    """A street of 60 views in no order, each point seen by 5 views that follow each other."""
    rng = np.random.default_rng(0)
    name = rng.permutation(60)
    first = rng.integers(0, 56, 900)
    point, view = np.repeat(np.arange(900), 5), name[(first[:, None] + np.arange(5)).ravel()]
    tracks = Tracks(np.zeros((900, 3)), point, view, np.zeros((4500, 2)))
    near = neighbourhoods(tracks, 60)
    np.testing.assert_array_equal(np.sort(near), np.arange(900))
    for block in np.split(near, 9):
        assert len(np.unique(view[np.isin(point, block)])) <= 20  # 60 in the points' own order


def test_one_thread_gives_the_same_model_to_the_last_bit(rendered):
    model = noisy_model(rendered, 1.0)
    one, two = (refine(model, rendered, passes=1)[0] for _ in range(2))
    for image_id in one.reg_image_ids():
        a, b = (m.image(image_id).cam_from_world().matrix() for m in (one, two))
        assert np.array_equal(a, b)


@pytest.mark.slow
def test_thresholds_refuse_what_makes_no_sense_and_have_effects(rendered):
    for wrong in ({"passes": 0}, {"radius": 0}, {"max_shift_px": 0.0}, {"min_score": 1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Refinement(**wrong)
    model = noisy_model(rendered, 1.0)
    base = refine(model, rendered, passes=1)[1].passes[0]
    for change in (
        {"min_score": 0.97},
        {"max_sigma_px": 0.05},
        {"max_shift_px": 0.7},
        {"min_cosine": 0.8},
        {"max_stretch": 1.2},
        {"max_error_px": 0.1},
        {"iterations": 2},
        {"radius": 3},
        {"neighbours": 6},
    ):
        figures = refine(model, rendered, passes=1, **change)[1].passes[0]
        assert dataclasses.astuple(figures) != dataclasses.astuple(base), change


# -- its parts -------------------------------------------------------------------------------------


def test_arrays_of_a_model_become_the_same_model(rendered):
    tracks = exact_tracks(rendered)
    model = arrays(exact_model(rendered).to_colmap(), rendered)
    views, back = model.views, model.tracks
    np.testing.assert_allclose(back.points, tracks.points)
    order = np.lexsort((back.view, back.point))
    np.testing.assert_array_equal(back.point[order], tracks.point)
    np.testing.assert_array_equal(back.view[order], tracks.view)
    np.testing.assert_allclose(back.xy[order], tracks.xy, atol=1e-9)
    for one, two in zip(views, rendered.views, strict=True):
        np.testing.assert_allclose(one.rotation, two.rotation, atol=1e-12)
        np.testing.assert_allclose(one.centre, two.centre, atol=1e-12)


def test_projection_and_rays_undo_each_other_for_any_camera_and_scale():
    pose = arc(3)[0]
    distorted = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=960, height=720, params=[900.0, 470.0, 350.0, -0.08]
    )
    view = dataclasses.replace(view_of(pose, 0), camera=distorted, pixels=Pixels((2.0, 1.9)))
    xy = np.random.default_rng(0).uniform([0, 0], [479, 359], (50, 2))
    back, depth = view.project(view.centre + 3.0 * view.rays(xy))
    np.testing.assert_allclose(back, xy, atol=1e-6)
    np.testing.assert_allclose(depth, 3.0)
    behind, depth = view.project(view.centre - view.rays(xy))
    assert np.isnan(behind).all() and (depth < 0).all()


def test_normals_are_the_planes_normals_and_face_the_cameras(rendered):
    got = plane_geometry.normals(exact_model(rendered), neighbours=12)
    cosine = np.abs(np.einsum("ni,ni->n", got, rendered.normals))
    assert np.mean(cosine > np.cos(np.radians(5))) > 0.8  # the rest lies where planes meet
    centre = np.mean([view.centre for view in rendered.views], axis=0)
    assert np.mean(np.einsum("ni,ni->n", got, centre - rendered.points) > 0) > 0.95


def test_plane_affines_are_derivatives_of_the_planes_homography(rendered):
    one, two = rendered.views[0], rendered.views[3]
    both = np.flatnonzero(rendered.visible[:, 0] & rendered.visible[:, 3])
    points, normals = rendered.points[both], rendered.normals[both]
    xy = one.project(points)[0]
    n = len(both)
    zeros, threes = np.zeros(n, int), np.full(n, 3)
    patches = plane_geometry.ReferencePatches(points, normals, zeros, xy)
    got = plane_affines(rendered.views, patches, threes)
    k = camera_matrix(SIZE)
    for i in range(0, n, 17):
        rotation = two.rotation @ one.rotation.T
        shift = two.rotation @ (one.centre - two.centre)
        normal = one.rotation @ normals[i]
        depth = normal @ (one.rotation @ (points[i] - one.centre))
        h = k @ (rotation + np.outer(shift, normal) / depth) @ np.linalg.inv(k)
        p = np.append(xy[i], 1.0)
        u, v, w = h @ p
        want = np.asarray([(h[r, :2] * w - (u, v)[r] * h[2, :2]) / w**2 for r in (0, 1)])
        np.testing.assert_allclose(got[i], want, rtol=1e-3, atol=1e-4)


def test_points_move_onto_their_reference_rays_within_their_planes(rendered):
    model = exact_model(rendered)
    tracks = model.tracks
    seen = plane_geometry.visibility(model, rendered.normals)
    reference = plane_geometry.reference_views(seen)
    assert seen.tracked[np.arange(len(reference)), reference].all()
    xy = seen.xy[np.arange(len(reference)), reference]
    moved_xy = xy + np.random.default_rng(2).normal(0, 1, xy.shape)
    moved = plane_geometry.on_reference_rays(model, rendered.normals, reference, moved_xy)
    off = np.einsum("ni,ni->n", moved - tracks.points, rendered.normals)
    assert np.mean(np.abs(off) < 1e-9) > 0.9  # else: nearly parallel, the depth was kept
    for k, view in enumerate(rendered.views):
        rows = reference == k
        np.testing.assert_allclose(view.project(moved[rows])[0], moved_xy[rows], atol=1e-6)


@pytest.mark.parametrize(("farther", "depth"), [(1.04, 1.04), (1.07, 1.0), (0.96, 0.96), (0.93, 1)])
def test_a_plane_that_moves_a_point_by_a_twentieth_of_its_depth_is_not_followed(
    rendered, farther, depth
):
    view = dataclasses.replace(rendered.views[0], rotation=np.eye(3), centre=np.zeros(3))
    # The plane leans by 45 degrees around the point (0, 0, 1); the ray meets it at `farther`.
    point, normal = np.asarray([[0.0, 0.0, 1.0]]), np.sqrt([[0.5, 0.0, 0.5]])
    ray = np.asarray([[1 / farther - 1, 0.0, 1.0]])
    moved = plane_geometry._on_planes(view, view.project(ray)[0], point, normal)
    np.testing.assert_allclose(moved, depth * ray, atol=1e-6)
