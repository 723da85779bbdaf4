"""Weak views against exact cameras and pixels of a rendered room, one view of which is noise."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from room_scene import (
    SIZE,
    Room,
    arrays,
    exact_model,
    exact_tracks,
    images_of,
    noisy_model,
    other_scene,
    read_of,
    refine,
    settings_of,
)
from scipy.spatial.transform import Rotation
from wall_scene import matched

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.refine import one_pass, passes, plane_geometry, weak_views
from jaxsfm.sfm.refine.candidates import may_be_candidates
from jaxsfm.sfm.refine.fixed_structure import (
    NO_MATCHES,
    FixedStructure,
    ResectionMatches,
    matched_points,
)
from jaxsfm.sfm.refine.octave_pose import PoseHypothesis, follow
from jaxsfm.sfm.refine.one_pass import run_pass
from jaxsfm.sfm.refine.passes import refine_model
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import align_blocks
from jaxsfm.sfm.refine.weak_views import register_weak_views

NIGHT, NIGHT_NAME = 2, "2.png"
PHOTONS = 0.02
"""Per unit of intensity: about two at a bright pixel."""


def by_night(scene: Room) -> Room:
    """The same room; one view counts photons."""
    counts = np.random.default_rng(0).poisson(PHOTONS * scene.images[NIGHT_NAME])
    return scene._replace(images=scene.images | {NIGHT_NAME: (counts / PHOTONS).astype(np.float32)})


def lost_view(
    scene: Room, *, turn_deg: float = 1.0, shift: float = 0.0, seen: int = 40
) -> pycolmap.Reconstruction:
    """The exact model, but the night view looks elsewhere and has few observations."""
    tracks = exact_tracks(scene)
    night = np.flatnonzero(tracks.view == NIGHT)
    keep = np.delete(np.arange(len(tracks.view)), night[seen:])
    tracks = tracks._replace(point=tracks.point[keep], view=tracks.view[keep], xy=tracks.xy[keep])
    views = list(scene.views)
    angle = np.radians(turn_deg)
    c, s = np.cos(angle), np.sin(angle)
    views[NIGHT] = dataclasses.replace(
        views[NIGHT],
        rotation=np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ views[NIGHT].rotation,
        centre=views[NIGHT].centre + [shift, 0, 0],
    )
    return Model(views, tracks).to_colmap()


def place(
    model,
    scene: Room,
    *,
    weak=(NIGHT_NAME,),
    refine_intrinsics=False,
    resection=NO_MATCHES,
    **config,
):
    """The COLMAP model with its weak views registered; the same object if nothing changed."""
    before = arrays(model, scene)
    after, registered = register_weak_views(
        before,
        weak,
        images_of(scene),
        refinement=Refinement(**config),
        refine_intrinsics=refine_intrinsics,
        resection=resection,
    )
    return (model if after is before else after.to_colmap()), registered


def night_error(model, scene: Room) -> tuple[float, float]:
    """Position and degrees, after a similarity from the other cameras."""
    others = [name for name in scene.poses if name != NIGHT_NAME]
    error = evaluate(model_poses(model), scene.poses, align_on=others).images[NIGHT_NAME]
    return error.position, error.rotation_deg


@pytest.mark.parametrize(("turn_deg", "shift"), [(0.0, 0.0), (1.0, 0.0), (1.0, 0.05)])
def test_a_view_of_photons_is_placed_where_it_is(rendered, turn_deg, shift):
    """Two photons at a bright pixel, and the pose up to 10 px off."""
    night = by_night(rendered)
    model, (registered,) = place(lost_view(night, turn_deg=turn_deg, shift=shift), night)
    assert (
        registered.octave_px in (2, 4, 8) and registered.agreed >= 100 and registered.error_px < 4
    )
    position, rotation = night_error(model, night)
    assert position < 0.01 and rotation < 0.15


def test_an_octave_is_repeated_until_the_view_stands_still(rendered):
    """One step each leaves 0.004 and 0.055 deg: the first finds half of the points."""
    night = by_night(rendered)
    model, (registered,) = place(lost_view(night, turn_deg=0.5), night, weak_octaves=2)
    position, rotation = night_error(model, night)
    assert registered.octave_px == 2 and position < 0.002 and rotation < 0.035


def test_refinement_places_a_view_that_it_cannot_align(rendered):
    night = by_night(rendered)
    tracks = exact_tracks(night)
    sigma = np.where(tracks.view == NIGHT, 3.0, 0.7)[:, None]
    noise = sigma * np.random.default_rng(1).normal(size=tracks.xy.shape)
    before = Model(night.views, tracks._replace(xy=tracks.xy + noise)).to_colmap()
    after, figures = refine(before, night)
    assert [p.name for p in figures.registrations] == [NIGHT_NAME] == figures.passes[-1].weak_views
    without, old = refine(before, night, weak_octaves=0)
    assert old.registrations[0].octave_px is None and old.passes == figures.passes
    registered, kept = night_error(after, night), night_error(without, night)
    assert registered[0] < 0.01 and registered[0] < 0.7 * kept[0]


def test_the_other_views_and_their_observations_stay(rendered):
    night = by_night(rendered)
    before = lost_view(night)
    after, _ = place(before, night)
    for image_id in before.reg_image_ids():
        if before.image(image_id).name != NIGHT_NAME:
            one, two = (m.image(image_id).cam_from_world().matrix() for m in (before, after))
            np.testing.assert_allclose(one, two, atol=1e-14)
    old, new = (arrays(m, night).tracks for m in (before, after))
    views = arrays(after, night).views
    assert (new.view != NIGHT).sum() == (old.view != NIGHT).sum()
    own = np.flatnonzero(new.view == NIGHT)
    assert len(own) > 100 and len(np.unique(new.point[own])) == len(own)
    off = views[NIGHT].project(new.points[new.point[own]])[0] - new.xy[own]
    assert np.abs(np.median(off, axis=0)).max() < 0.25


def test_a_view_of_something_else_stays_as_it_was(rendered):
    elsewhere = rendered._replace(images=rendered.images | {NIGHT_NAME: other_scene(0)})
    before = lost_view(elsewhere)
    after, (registered,) = place(before, elsewhere)
    assert (
        registered.octave_px is None and registered.error_px is None and registered.candidates > 100
    )
    assert after is before


def test_a_model_of_weak_views_alone_stays_as_it_was(rendered):
    before = lost_view(rendered)
    after, registered = place(before, rendered, weak=list(rendered.images))
    assert after is before and all(p.octave_px is None and not p.candidates for p in registered)


def without(visible: np.ndarray, view: int) -> np.ndarray:
    """The same, but that view sees nothing."""
    return visible & (np.arange(visible.shape[1]) != view)


def without_night(scene: Room) -> pycolmap.Reconstruction:
    """The exact model of the other views."""
    use = without(scene.visible, NIGHT)
    views = [view for k, view in enumerate(scene.views) if k != NIGHT]
    tracks = exact_tracks(scene, use=use)
    shifted = tracks._replace(view=tracks.view - (tracks.view > NIGHT))
    return Model(views, shifted).to_colmap()


def night_matches(scene: Room, *, right: int, wrong: int) -> ResectionMatches:
    """With every other view so many matches, keypoints 3 px off at night."""
    rng = np.random.default_rng(0)
    results = {}
    for k, view in enumerate(scene.views):
        if k == NIGHT:
            continue
        both = np.flatnonzero(scene.visible[:, k] & scene.visible[:, NIGHT])
        points = scene.points[rng.permutation(both)[: right + wrong]]
        day = view.project(points)[0]
        night = scene.views[NIGHT].project(points)[0] + rng.normal(0, 3, day.shape)
        night[right:] = rng.uniform((0, 0), SIZE, night[right:].shape)
        result = matched((view.name, NIGHT_NAME), day, night)
        results[result.pair] = result
    return ResectionMatches(results, 0)


def test_matches_bring_a_lost_view_back(rendered):
    """From where alignment alone does not find home."""
    night = by_night(rendered)
    before = lost_view(night, turn_deg=25.0, shift=0.3)
    assert place(before, night)[1][0].octave_px is None
    after, (registered,) = place(before, night, resection=night_matches(night, right=20, wrong=20))
    assert registered.registered and night_error(after, night)[0] < 0.01


def with_night_camera(model, scene: Room, alone: pycolmap.Camera) -> pycolmap.Reconstruction:
    """The model with another camera for the night view."""
    before = arrays(model, scene)
    views = list(before.views)
    views[NIGHT] = dataclasses.replace(views[NIGHT], camera=alone)
    return before.with_views(views).to_colmap()


@pytest.mark.parametrize(("own", "refined"), [(True, True), (False, False)])
def test_only_a_camera_of_its_own_gets_another_focal_length(rendered, own, refined):
    night = by_night(rendered)
    before = lost_view(night, turn_deg=0.0)
    right = before.camera(1).focal_length_x
    if own:
        alone = pycolmap.Camera(before.camera(1).todict())
        alone.camera_id = 2
        alone.focal_length_x = alone.focal_length_y = 1.03 * right
        before = with_night_camera(before, night, alone)
    after, (registered,) = place(before, night, refine_intrinsics=True)
    assert registered.octave_px is not None
    found = after.image(NIGHT + 1).camera
    if refined:
        assert abs(found.focal_length_x / right - 1) < 0.01
    else:
        assert found.focal_length_x == right


def test_targets_are_a_part_of_all_views(rendered):
    """Aligning to some views gives what aligning to all gives there, to the last bit."""
    refinement = Refinement()
    limits = AlignmentLimits.of(refinement)
    arguments = (exact_model(rendered), images_of(rendered), refinement, limits)
    (every,) = align_blocks(*arguments)
    (some,) = align_blocks(*arguments, targets=[1, 3])
    mine = np.isin(every.found.view, [1, 3])
    for field in ("point", "view", "start", "affine"):
        np.testing.assert_array_equal(
            getattr(some.found, field), getattr(every.found, field)[mine], field
        )
    np.testing.assert_array_equal(some.moved, every.moved[mine])
    np.testing.assert_array_equal(some.agrees, every.agrees[mine])


def test_only_points_that_a_target_may_show_are_looked_at(rendered):
    """A view that looks aside: what it shows is the same, the rest of the model costs nothing."""
    model, refinement, views = exact_model(rendered), Refinement(), rendered.views

    def turned(degrees: float) -> View:
        turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        return dataclasses.replace(views[1], rotation=turn @ views[1].rotation)

    def aligned(view: View, targets):
        some = model.with_views([*views, dataclasses.replace(view, image_id=99)])
        limits = AlignmentLimits.of(refinement)
        return list(align_blocks(some, images_of(rendered), refinement, limits, targets=targets))

    (every,) = aligned(turned(35), None)
    (some,) = aligned(turned(35), [len(views)])
    assert 0 < len(some.rows) < 0.8 * len(every.rows)
    mine = every.found.view == len(views)
    assert mine.any()
    np.testing.assert_array_equal(some.rows[some.found.point], every.rows[every.found.point][mine])
    np.testing.assert_array_equal(some.moved, every.moved[mine])
    assert aligned(turned(180), [len(views)]) == []
    behind = PoseHypothesis(view=turned(180), own_camera=False)
    follow([behind], FixedStructure(model, images_of(rendered), refinement))
    assert behind.best is None and behind.agreed == 0


def test_views_that_neither_observe_a_point_nor_are_targets_cost_nothing(rendered, monkeypatch):
    model, looked_at, visibility = exact_model(rendered), [], plane_geometry.visibility
    idle = [dataclasses.replace(rendered.views[1], image_id=90 + k) for k in range(3)]
    some = model.with_views([*rendered.views, *idle])

    def counted(part, normal):
        looked_at.append({view.image_id for view in part.views})
        return visibility(part, normal)

    monkeypatch.setattr(plane_geometry, "visibility", counted)
    arguments = (some, images_of(rendered), Refinement(), AlignmentLimits.of(Refinement()))
    (of_target,) = align_blocks(*arguments, targets=[len(rendered.views)])
    (of_all,) = align_blocks(*arguments)
    observing = {some.views[k].image_id for k in np.unique(some.tracks.view)}
    assert looked_at == [observing | {90}, observing | {90, 91, 92}]
    assert set(of_target.found.view) == {len(rendered.views)} < set(of_all.found.view)


@pytest.mark.parametrize("back", [0.0, 8.0, 40.0])
def test_points_that_cannot_become_candidates_are_not_looked_at(rendered, back):
    """A view from farther away has all points in its image, and could align none of them."""
    model, refinement = exact_model(rendered), Refinement().in_all_views()
    view = rendered.views[1]
    away = dataclasses.replace(view, image_id=99, centre=view.centre - back * view.rotation[2])
    some, k = model.with_views([*rendered.views, away]), len(rendered.views)
    normal = plane_geometry.normals(some, neighbours=refinement.neighbours)
    wanted = may_be_candidates(some, normal, refinement, [k])
    limits = AlignmentLimits.of(refinement)
    (every,) = align_blocks(some, images_of(rendered), refinement, limits, normal=normal)
    found = every.rows[every.found.point[every.found.view == k]]
    assert set(found) <= set(np.flatnonzero(wanted))
    share = wanted.sum() / len(wanted)
    assert {0.0: share > 0.4, 8.0: 0.1 < share < 0.6, 40.0: share == 0}[back]


@pytest.mark.filterwarnings("error")
def test_a_view_that_stands_in_a_point_does_not_see_it(rendered):
    """The solver may leave a camera there. Nothing is said of it, and no warning is printed."""
    model, refinement, k = exact_model(rendered), Refinement().in_all_views(), len(rendered.views)
    there = dataclasses.replace(rendered.views[1], image_id=99, centre=model.tracks.points[0])
    some = model.with_views([*rendered.views, there])
    normal = plane_geometry.normals(some, neighbours=refinement.neighbours)
    cosine, log_scale = plane_geometry.seen_by([there], 0, some.tracks.points, normal)
    assert (
        np.flatnonzero(np.isnan(cosine)).tolist()
        == [0]
        == np.flatnonzero(np.isnan(log_scale)).tolist()
    )
    assert not may_be_candidates(some, normal, refinement, [k])[0]


def test_matches_give_the_surface_under_them_whichever_image_comes_first(rendered):
    before = without_night(rendered)
    resection = night_matches(rendered, right=30, wrong=0)
    assert {pair[0] == NIGHT_NAME for pair in resection.matches} == {True, False}
    model = arrays(before, rendered)
    normal = plane_geometry.normals(model, neighbours=16)
    xy, points = matched_points(rendered.views[NIGHT], model, normal, resection.matches)
    off = np.linalg.norm(rendered.views[NIGHT].project(points)[0] - xy, axis=1)
    assert len(off) > 60 and np.median(off) < 6 and np.quantile(off, 0.9) < 12


@pytest.mark.parametrize("own", [True, False])
def test_a_shared_camera_is_no_views_own(monkeypatch, rendered, own):
    before = lost_view(rendered)
    if own:
        alone = pycolmap.Camera(before.camera(1).todict())
        alone.camera_id = 2
        before = with_night_camera(before, rendered, alone)
    followed = []
    monkeypatch.setattr(weak_views, "follow", lambda poses, *_: followed.extend(poses))
    place(before, rendered, refine_intrinsics=True)
    assert [pose.own_camera for pose in followed] == [own]
    place(before, rendered, refine_intrinsics=False)
    assert not followed[-1].own_camera


@pytest.mark.parametrize("last", [True, False])
def test_a_view_that_is_doubtful_in_the_last_pass_is_placed_as_a_weak_one(
    rendered, last, monkeypatch
):
    """The mapper's pose is wrong, but as many observations agree as it had."""
    calls = []

    def doubting(before, images, px, limits, settings):
        calls.append(px)
        _, done = run_pass(before, images, px, limits, settings)
        doubtful = [NIGHT_NAME] if last or len(calls) == 1 else []
        return before, dataclasses.replace(done, weak_views=[], doubtful_views=doubtful)

    monkeypatch.setattr(passes, "run_pass", doubting)
    before = lost_view(rendered, turn_deg=2.0)
    after, figures = refine_model(before, read_of(rendered), settings_of())
    assert calls == [1, 1]
    assert (max(night_error(after, rendered)) < 0.1) == last
    assert [(at.name, at.registered, at.octave_px) for at in figures.registrations] == (
        [(NIGHT_NAME, True, 1)] if last else []
    )


@pytest.mark.parametrize(("turn_deg", "found"), [(0.0, []), (4.0, [NIGHT_NAME])])
def test_a_view_is_doubtful_if_it_shows_little_of_what_it_should_show(rendered, turn_deg, found):
    model = arrays(lost_view(rendered, turn_deg=turn_deg), rendered)
    limits = AlignmentLimits.of(Refinement())
    blocks = list(align_blocks(model, images_of(rendered), Refinement(), limits))
    assert [view.name for view in one_pass._doubtful(model.views, blocks)] == found


def test_no_view_is_doubtful_where_all_poses_are_right(rendered):
    _, figures = refine(noisy_model(rendered, 0.7), rendered)
    assert [done.doubtful_views for done in figures.passes] == [
        [],
        [],
    ] and not figures.registrations
