"""Laws of new points, on the rendered room with exact matches."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from room_scene import SIZE, Room, exact_model, exact_tracks, images_of

from jaxsfm.colmap.model import Model
from jaxsfm.config import Refinement
from jaxsfm.core.types import Status
from jaxsfm.io.pairs import Pair, PairResult, exhaustive_pairs
from jaxsfm.sfm.refine.fixed_structure import ResectionMatches
from jaxsfm.sfm.register import grow as grow_module
from jaxsfm.sfm.register import triangulate
from jaxsfm.sfm.register.grow import grow
from jaxsfm.sfm.register.locate_view import UnregisteredView
from jaxsfm.sfm.register.triangulate import matched_tracks, new_points, triangulated

NEW = "3.png"


def all_matches(scene: Room, *, sigma: float = 0.0) -> dict[Pair, PairResult]:
    """Of all pairs; a point's number is its cell; a keypoint is the same in every pair."""
    rng = np.random.default_rng(0)
    xy = {}
    for view in scene.views:
        at = view.project(scene.points)[0]
        xy[view.name] = (at + rng.normal(0, sigma, at.shape)).astype(np.float32)
    index = {view.name: k for k, view in enumerate(scene.views)}
    found = {}
    for a, b in exhaustive_pairs(index):
        both = np.flatnonzero(scene.visible[:, index[a]] & scene.visible[:, index[b]])
        found[a, b] = PairResult(
            pair=(a, b),
            cells=np.c_[both, both].astype(np.int32),
            keypoints0=xy[a][both],
            keypoints1=xy[b][both],
            plane=np.zeros(len(both), np.int32),
            homographies=np.eye(3)[None],
            num_tentative=len(both),
            num_dropped=0,
            status=Status.VERIFIED,
        )
    return found


def half_known(scene: Room) -> Model:
    """The model of every other point, without observations of the new view."""
    model = exact_model(scene)
    known = np.arange(len(scene.points)) % 2 == 0
    return model.select(known[model.tracks.point] & (model.tracks.view != 3))


def of_three_views(scene: Room, *, every: int = 1) -> Model:
    """The model of the first three views, with each so-many-th of its points."""
    use = scene.visible.copy()
    use[:, 3:] = False
    use[np.arange(len(use)) % every > 0] = False
    use[use.sum(1) < 2] = False
    return Model(scene.views[:3], exact_tracks(scene, use=use))


def test_rays_meet_where_the_points_are(rendered):
    model = exact_model(rendered)
    nowhere = model.tracks._replace(points=np.zeros_like(model.tracks.points))
    found = triangulated(model.with_tracks(nowhere)).tracks
    np.testing.assert_allclose(found.points, rendered.points, atol=1e-6)
    alone = model.select(model.tracks.view == 0)
    assert np.isnan(triangulated(alone).tracks.points).all()


def test_a_camera_whose_distortion_cannot_be_undone_gives_no_rays(rendered):
    """A mapper that follows false matches may end with such a camera."""
    model = exact_model(rendered)
    (width, height), focal = SIZE, model.views[0].camera.mean_focal_length()
    params = [focal, width / 2, height / 2, -5.0]
    bent = pycolmap.Camera(model="SIMPLE_RADIAL", width=width, height=height, params=params)
    views = [dataclasses.replace(model.views[0], camera=bent), *model.views[1:]]
    tracks = model.tracks
    own = tracks.view == 0
    lost = ~np.isfinite(views[0].rays(tracks.xy[own])).all(1)
    assert lost.any()
    found = triangulated(Model(views, tracks)).tracks.points
    others = np.bincount(tracks.point[~own], minlength=len(found))
    seen_well = np.setdiff1d(np.flatnonzero(others > 1), tracks.point[own][~lost])
    np.testing.assert_allclose(found[seen_well], rendered.points[seen_well], atol=1e-6)


def test_what_has_a_point_gets_no_other_and_the_rest_is_found_where_it_is(rendered):
    model = half_known(rendered)
    tracks = model.tracks
    made = new_points(model, {NEW}, all_matches(rendered), images_of(rendered), refinement=None)
    assert len(made.points) > 100
    distance = np.linalg.norm(made.points[:, None] - rendered.points[None], axis=2)
    nearest = distance.argmin(1)
    assert distance.min(1).max() < 1e-3
    assert len(np.unique(nearest)) == len(nearest)
    # A point with an observation in each of the views is known; new ones lack it in one at least.
    for k in range(len(rendered.views)):
        own, old = made.xy[made.view == k], tracks.xy[tracks.view == k]
        if len(own) and len(old):
            assert np.linalg.norm(own[:, None] - old[None], axis=2).min() > 3.9


def test_a_keypoint_that_leads_to_two_of_one_view_makes_no_point(rendered):
    model = half_known(rendered)
    matches = all_matches(rendered)
    fresh = {NEW, "4.png"}
    right = matched_tracks(model, fresh, matches)
    pair = ("0.png", NEW)
    wrong = matches[pair]
    cells = wrong.cells.copy()
    cells[:, 0] = np.roll(cells[:, 0], 1)  # now each leads to another point's keypoint in view 0
    matches[pair] = dataclasses.replace(
        wrong, cells=cells, keypoints0=np.roll(wrong.keypoints0, 1, axis=0)
    )
    mixed = matched_tracks(model, fresh, matches)
    assert len(mixed.points) < len(right.points)
    for point in range(len(mixed.points)):
        seen = mixed.view[mixed.point == point]
        assert len(np.unique(seen)) == len(seen)


@pytest.mark.parametrize("refinement", [None, Refinement()])
def test_alignment_takes_the_noise_of_matches_away(rendered, refinement):
    matches = all_matches(rendered, sigma=1.0)
    model = half_known(rendered)
    made = new_points(model, {NEW}, matches, images_of(rendered), refinement=refinement)
    planes = np.stack([rendered.points, rendered.normals], axis=1)
    off = np.abs(np.einsum("npk,pk->np", made.points[:, None] - planes[None, :, 0], planes[:, 1]))
    error = np.median(off[np.arange(len(off)), _nearest(made.points, rendered.points)])
    assert error < 0.004 if refinement else error > 0.004


@pytest.mark.parametrize("missing", [0, 1])
def test_as_few_new_points_as_a_model_needs_are_aligned(rendered, monkeypatch, missing):
    aligned = []
    blocks = triangulate.align_blocks
    monkeypatch.setattr(
        triangulate, "align_blocks", lambda *rest: aligned.append(1) or blocks(*rest)
    )
    arguments = half_known(rendered), {NEW}, all_matches(rendered), images_of(rendered)
    count = len(new_points(*arguments, refinement=None).points)
    assert not aligned
    monkeypatch.setattr(triangulate, "MIN_NEW_POINTS", count + missing)
    new_points(*arguments, refinement=Refinement())
    assert bool(aligned) == (missing == 0)


def _nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=2).argmin(1)


def test_a_view_that_only_a_new_one_reaches_comes_in_the_next_round(rendered):
    """View 4 is matched with view 3 alone, which is new itself."""
    known = of_three_views(rendered)
    tracks = known.tracks
    every = {view.name: view for view in rendered.views}
    unregistered = {
        NEW: UnregisteredView([every[NEW]], False, ["0.png", "1.png", "2.png", "4.png"]),
        "4.png": UnregisteredView([every["4.png"]], False, [NEW]),
    }
    grown = grow(
        [known],
        unregistered,
        ResectionMatches(all_matches(rendered), 0),
        images_of(rendered),
        refinement=Refinement(),
    )
    assert [*grown.registered] == [NEW, "4.png"] and grown.rounds == 2
    (model,) = grown.models
    points = model.tracks.points
    np.testing.assert_array_equal(points[: len(tracks.points)], tracks.points)
    assert len(points) > len(tracks.points)
    for view, truth in zip(model.views, rendered.views, strict=True):
        np.testing.assert_allclose(view.centre, truth.centre, atol=0.02)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_view_gets_its_place_in_the_model_of_which_it_shows_most_points(rendered, swapped):
    """It could be registered in the model of fewer points, too, which stays as it is."""
    models = [of_three_views(rendered, every=2), of_three_views(rendered)]
    every = {view.name: view for view in rendered.views}
    order = [1, 0] if swapped else [0, 1]

    def grown(chosen: list[Model]):
        view = UnregisteredView([every[NEW]] * len(chosen), False, ["0.png", "1.png", "2.png"])
        return grow(
            chosen,
            {NEW: view},
            ResectionMatches(all_matches(rendered), 0),
            images_of(rendered),
            refinement=Refinement(),
        )

    assert grown(models[:1]).registered == {NEW: 0}
    both = grown([models[k] for k in order])
    assert both.registered == {NEW: order.index(1)}
    assert both.models[order.index(0)] is models[0]
    assert len(both.models[order.index(1)].views) == 4
    assert both.located[NEW].agreed > grown(models[:1]).located[NEW].agreed


@pytest.mark.parametrize("missing", [0, 1])
def test_a_view_that_too_few_points_hold_is_not_placed(rendered, monkeypatch, missing):
    """Later rounds would place views on the points that it adds."""
    model = of_three_views(rendered)
    view = {view.name: view for view in rendered.views}[NEW]
    unregistered = {NEW: UnregisteredView([view], False, ["0.png", "1.png", "2.png"])}

    def grown():
        return grow(
            [model],
            unregistered,
            ResectionMatches(all_matches(rendered), 0),
            images_of(rendered),
            refinement=Refinement(),
        )

    points = grown().located[NEW].points
    assert points is not None
    monkeypatch.setattr(grow_module, "MIN_COUNT", len(points.rows) + missing)
    found = grown()
    assert bool(found.registered) == (missing == 0)
    why = found.located[NEW].why
    assert why is None if not missing else f"only {len(points.rows)} of them hold it" in (why or "")
