"""Laws of the search around poses: a photo of which only a corner is lit."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from room_scene import SIZE, Room, exact_model, images_of
from scipy.spatial.transform import Rotation
from wall_scene import matched

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.photos import Pixels
from jaxsfm.sfm.refine import octave_pose, plane_geometry, pose_search
from jaxsfm.sfm.refine.fixed_structure import (
    NO_MATCHES,
    AlignedPoints,
    FixedStructure,
    ResectionMatches,
)
from jaxsfm.sfm.refine.octave_pose import OctavePose, PoseHypothesis, follow, trusted
from jaxsfm.sfm.refine.pose_search import MIN_PATCHES, search
from jaxsfm.sfm.refine.weak_views import register_weak_views
from jaxsfm.sfm.register import locate_view
from jaxsfm.sfm.register.locate_view import Localization, locate

NIGHT, NIGHT_NAME = 2, "2.png"
DAYS = [f"{k}.png" for k in range(5) if k != NIGHT]
REFINEMENT = Refinement(weak_octaves=2)


def lit_in_a_corner(scene: Room) -> Room:
    """The same room; one view is noise, but for a corner."""
    dark = np.random.default_rng(0).normal(60, 25, SIZE[::-1]).astype(np.float32)
    dark[150:300, 240:] = scene.images[NIGHT_NAME][150:300, 240:]
    return scene._replace(images=scene.images | {NIGHT_NAME: dark})


def by_day(scene: Room) -> Model:
    """What the other views make."""
    use = scene.visible.copy()
    use[:, NIGHT] = False
    seen = use.sum(1) >= 2
    known = scene._replace(points=scene.points[seen], visible=scene.visible[seen])
    return exact_model(known, use=use[seen]).part(DAYS)[0]


def structure_of(scene: Room, refinement: Refinement = REFINEMENT) -> FixedStructure:
    return FixedStructure(by_day(scene), images_of(scene), refinement)


def turned(view: View, degrees: float) -> View:
    turn = Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    return dataclasses.replace(view, rotation=turn @ view.rotation)


def followed(scene: Room, degrees: float) -> PoseHypothesis:
    """A start that is turned, followed and searched around."""
    pose = PoseHypothesis(view=turned(scene.views[NIGHT], degrees), own_camera=False)
    follow([pose], structure_of(scene))
    search([pose], structure_of(scene))
    return pose


def off_px(view: View, scene: Room) -> float:
    way = view.project(scene.points)[0] - scene.views[NIGHT].project(scene.points)[0]
    return float(np.median(np.linalg.norm(way, axis=1)))


@pytest.fixture
def much_is_asked(monkeypatch):
    """Three tenths of what a view could show must agree. The lit corner has two."""
    monkeypatch.setattr(octave_pose, "MIN_SHARE", 0.3)


def test_a_pose_that_shows_little_is_trusted_if_it_stands_out(rendered, much_is_asked):
    scene = lit_in_a_corner(rendered)
    pose = followed(scene, 0.0)
    found = trusted(pose)
    assert found is not None and found is pose.stands_out
    assert pose.share < 0.25 and off_px(found.view, scene) < 0.5


def test_a_pose_climbs_to_where_most_agrees(rendered):
    """It starts half a patch's side off, from where alignment finds nothing."""
    scene = lit_in_a_corner(rendered)
    alone = PoseHypothesis(view=turned(scene.views[NIGHT], 2.0), own_camera=False)
    follow([alone], structure_of(scene))
    assert not alone.octaves
    found = trusted(followed(scene, 2.0))
    assert found is not None and off_px(found.view, scene) < 0.5


@pytest.mark.parametrize("degrees", [6.0, 25.0])
def test_a_pose_far_from_where_anything_agrees_is_not_trusted(rendered, degrees, much_is_asked):
    pose = followed(lit_in_a_corner(rendered), degrees)
    assert trusted(pose) is None and pose.stands_out is None


def test_what_a_descent_found_is_forgotten_when_a_pose_climbs_away(rendered, monkeypatch):
    view = rendered.views[NIGHT]
    stale = _octave(view, 1, uncertainty_px=0.1)
    pose = PoseHypothesis(view=view, own_camera=False, octaves={1: stale}, share=0.9)
    counts = {0: 31, 1: 35}  # of the pose itself, and of the first one beside it

    def converge(tried, *_):
        for k, each in enumerate(tried):
            each.agreed = counts.get(k, 0)

    monkeypatch.setattr(pose_search, "converge", converge)
    monkeypatch.setattr(pose_search, "follow", lambda moved, *_: None)
    search([pose], structure_of(rendered))
    assert pose.octaves == {} and pose.share == 0.0 and pose.view is not view


@pytest.mark.parametrize(
    ("own", "beside", "climbs"), [(31, 34, False), (31, 35, True), (0, 29, False), (0, 30, True)]
)
def test_a_pose_climbs_only_for_a_tenth_more_and_enough(rendered, monkeypatch, own, beside, climbs):
    pose = PoseHypothesis(view=rendered.views[NIGHT], own_camera=False)
    counts = [own, *[0] * 4, beside, 0, 0, 0]

    def converge(tried, *_):
        for each, count in zip(tried, counts, strict=True):
            each.agreed = count
        counts[:] = [99, *[0] * 8]  # the next step stays

    monkeypatch.setattr(pose_search, "converge", converge)
    moved = pose_search._climb([pose], structure_of(rendered))
    assert bool(moved) is climbs
    # The fifth of eight directions is opposite to the first: the photo's middle moves to the left.
    way = pose.view.project(rendered.points)[0] - rendered.views[NIGHT].project(rendered.points)[0]
    side = 2 * REFINEMENT.radius + 1
    assert np.median(way[:, 0]) == pytest.approx(-0.8 * side if climbs else 0, abs=0.1 * side)


def _octave(
    view: View, px: int, *, uncertainty_px: float, patches: int = MIN_PATCHES
) -> OctavePose:
    """A pose at which 40 of 100 points agree."""
    offsets = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    could = view.centre + 5 * view.rotation[2] + offsets
    seen = AlignedPoints(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2)), could)
    return OctavePose(view, px, seen, 40, 1.0, uncertainty_px, patches)


def _shown(count: int, could: int = 100) -> SimpleNamespace:
    return SimpleNamespace(rows=range(count), candidates=range(could))


def _compared(monkeypatch, rendered: Room, poses: list[PoseHypothesis], beside, octaves=2) -> None:
    """Compare poses; `beside` gives what a view beside them shows, of its number and octave."""

    def shown_from(_, views, px):
        return [(view, beside(k, px)) for k, view in enumerate(views)]

    monkeypatch.setattr(FixedStructure, "shown_from", shown_from)
    pose_search._compare(poses, structure_of(rendered, Refinement(weak_octaves=octaves)))


def _hypothesis(view: View, *octaves: OctavePose) -> PoseHypothesis:
    own = {each.octave_px: each for each in octaves}
    return PoseHypothesis(view=view, own_camera=False, octaves=own)


@pytest.mark.parametrize(
    ("beside", "could", "patches", "right"),
    [
        (8, 100, 20, True),
        (9, 100, 20, False),
        (0, 100, 20, True),
        (8, 100, 19, False),
        (5, 50, 20, False),  # a tenth of what it could show
        (4, 50, 20, True),
        (9, 49, 20, True),  # it could show too little to say anything
    ],
)
def test_a_pose_stands_out_with_five_times_what_is_beside_it_in_enough_patches(
    rendered, monkeypatch, beside, could, patches, right
):
    view = rendered.views[NIGHT]
    one = _octave(view, 2, uncertainty_px=9.0, patches=patches)
    pose = _hypothesis(view, one)
    shown = [_shown(0), _shown(0), _shown(beside, could), _shown(0)]
    _compared(monkeypatch, rendered, [pose], lambda k, _: shown[k])
    assert pose.stands_out is (one if right else None)


def test_a_pose_of_which_nothing_can_be_said_beside_it_does_not_stand_out(rendered, monkeypatch):
    pose = _hypothesis(rendered.views[NIGHT], _octave(rendered.views[NIGHT], 2, uncertainty_px=0.1))
    _compared(monkeypatch, rendered, [pose], lambda *_: _shown(0, 49))
    assert pose.searched and pose.stands_out is None


def test_poses_beside_are_turned_by_two_patches_to_four_sides(rendered, monkeypatch):
    view, ways = rendered.views[NIGHT], []
    middle = view.centre[None] + 5 * view.rotation[2]

    def shown_from(_, views, px):
        ways.extend(each.project(middle)[0][0] - view.project(middle)[0][0] for each in views)
        return [(each, _shown(0)) for each in views]

    monkeypatch.setattr(FixedStructure, "shown_from", shown_from)
    pose = _hypothesis(view, _octave(view, 2, uncertainty_px=0.1))
    pose_search._compare([pose], structure_of(rendered))
    np.testing.assert_allclose(ways, [[60, 0], [-60, 0], [0, 60], [0, -60]], atol=2)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_a_turn_moves_what_the_middle_shows_by_working_pixels(rendered, scale):
    view = rendered.views[NIGHT]
    view = dataclasses.replace(view, pixels=Pixels((scale, scale)))
    middle = view.centre[None] + 5 * view.rotation[2]
    way = pose_search._turned(view, np.asarray([9.0, -6.0])).project(middle)[0][0]
    np.testing.assert_allclose(way - view.project(middle)[0][0], [9, -6], atol=0.1)


@pytest.mark.parametrize(
    ("beside", "best"), [({}, 1), ({1: 9}, 2), ({1: 9, 2: 9}, 4), ({4: 9}, None)]
)
def test_the_coarsest_octave_stands_out_and_of_those_that_do_the_surest_counts(
    rendered, monkeypatch, beside, best
):
    view = rendered.views[NIGHT]
    octaves = [_octave(view, px, uncertainty_px=d) for px, d in ((4, 1.5), (2, 1.2), (1, 0.9))]
    for order in (octaves, octaves[::-1]):
        pose = _hypothesis(view, *order)
        _compared(monkeypatch, rendered, [pose], lambda _, px: _shown(beside.get(px, 0)), 3)
        found = pose.stands_out
        assert (found and found.octave_px) == best


@pytest.mark.parametrize(("px", "same"), [(27.0, True), (33.0, False), (200.0, False)])
def test_an_octave_that_gives_another_place_does_not_count(rendered, monkeypatch, px, same):
    """Off by more than a patch's side of 2 x 15 pixels."""
    view = rendered.views[NIGHT]
    away = pose_search._turned(view, np.asarray([px, 0.0]))
    coarse, other = _octave(view, 2, uncertainty_px=1.5), _octave(away, 1, uncertainty_px=0.1)
    pose = _hypothesis(view, coarse, other)
    _compared(monkeypatch, rendered, [pose], lambda *_: _shown(0))
    assert pose.stands_out is (other if same else coarse)


def test_a_pose_is_judged_by_itself(rendered, monkeypatch):
    view = rendered.views[NIGHT]
    one = _octave(view, 2, uncertainty_px=0.1)
    for first in (True, False):
        good, bad = _hypothesis(view, one), _hypothesis(view, one)
        poses = [good, bad] if first else [bad, good]
        wrong = range(4, 8) if first else range(4)
        _compared(monkeypatch, rendered, poses, lambda k, _: _shown(9 if k in wrong else 0))  # noqa: B023
        assert good.stands_out is one and bad.stands_out is None


def test_a_climb_has_four_steps_in_eight_directions(rendered, monkeypatch):
    tried = []

    def converge(poses, *_):
        tried.append([each.view for each in poses])
        for k, each in enumerate(poses):
            each.agreed = (30 * 2 ** len(tried)) * (
                k == 3
            )  # the third direction is better each time

    monkeypatch.setattr(pose_search, "converge", converge)
    view = rendered.views[NIGHT]
    pose = PoseHypothesis(view=view, own_camera=False)
    assert pose_search._climb([pose], structure_of(rendered)) == [pose]
    assert len(tried) == 4 and pose.view is tried[-1][3]
    middle = view.centre[None] + 5 * view.rotation[2]
    ways = [each.project(middle)[0][0] - view.project(middle)[0][0] for each in tried[0]]
    angles = np.arange(8) * np.pi / 4
    expected = 12 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(ways, [[0, 0], *expected], atol=0.5)


def test_small_photos_are_not_searched_around(rendered):
    """At an eighth of their size there is no room for twenty patches."""
    view = rendered.views[NIGHT]
    pose = PoseHypothesis(
        view=view, own_camera=False, octaves={1: _octave(view, 1, uncertainty_px=0.1)}
    )
    search([pose], structure_of(rendered, Refinement(weak_octaves=4)))
    assert not pose.searched
    for width, has_room in ((1200, True), (1199, False)):  # forty patches of 120 x 120 pixels
        some = dataclasses.replace(view, size=(width, 480))
        assert pose_search._has_room(some, Refinement(weak_octaves=4)) is has_room


def test_after_a_search_a_pose_has_to_stand_out(rendered):
    view = rendered.views[NIGHT]
    sure = _octave(view, 1, uncertainty_px=0.1)
    pose = PoseHypothesis(view=view, own_camera=False, octaves={1: sure}, share=0.9)
    assert trusted(pose) is sure
    assert trusted(dataclasses.replace(pose, searched=True)) is None
    for uncertainty_px, right in ((2.0, True), (2.01, False)):
        found = _octave(view, 2, uncertainty_px=uncertainty_px)
        after = dataclasses.replace(pose, searched=True, stands_out=found, share=0.01)
        assert trusted(after) is (found if right else None)


def test_the_refinement_searches_around_views_that_it_cannot_place(rendered, much_is_asked):
    """The view starts half a patch's side off, and a corner of it is lit."""
    scene = lit_in_a_corner(rendered)
    whole = exact_model(scene)
    views = list(whole.views)
    views[NIGHT] = turned(views[NIGHT], 2.0)
    model, (placed,) = register_weak_views(
        whole.with_views(views),
        [NIGHT_NAME],
        images_of(scene),
        refinement=REFINEMENT,
        refine_intrinsics=False,
        resection=NO_MATCHES,
    )
    assert placed.octave_px is not None and off_px(model.views[NIGHT], scene) < 0.5


def localized(scene: Room, shift: float) -> Localization:
    """From forty matches that put the view at a turned pose."""
    view, day = turned(scene.views[NIGHT], shift), scene.views[1]
    rows = np.flatnonzero(scene.visible[:, [1, NIGHT]].all(1))[::5][:40]
    at, there = (each.project(scene.points[rows])[0] for each in (day, view))
    matches = {("1.png", NIGHT_NAME): matched(("1.png", NIGHT_NAME), at, there)}
    return locate(view, structure_of(scene), ResectionMatches(matches, 0), own_camera=False)


def test_a_photo_of_which_a_corner_is_lit_is_localized(rendered, much_is_asked):
    found = localized(lit_in_a_corner(rendered), 1.0)
    assert found.trusted and found.view is not None
    assert off_px(found.view, rendered) < 0.5


def test_a_search_does_not_leave_many_matches_that_agree(rendered, much_is_asked):
    """Two steps of the climb away, the photo shows more."""
    scene = lit_in_a_corner(rendered)
    found = localized(scene, 2.0)
    assert found.trusted
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(locate_view, "LEAVES", 1.0)
        patch.setattr(locate_view, "MATCH_ERROR_PX", 3.0)
        found = localized(scene, 2.0)
    assert not found.trusted and "most of these matches contradict" in str(found.why)


def test_the_normals_of_a_structure_hold_in_every_octave_and_are_found_once(rendered, monkeypatch):
    model, calls, normals = by_day(rendered), [], plane_geometry.normals

    def counted(some, **options):
        calls.append(some)
        return normals(some, **options)

    monkeypatch.setattr(plane_geometry, "normals", counted)
    structure = FixedStructure(model, images_of(rendered), REFINEMENT)
    pose = PoseHypothesis(view=rendered.views[NIGHT], own_camera=False)
    follow([pose], structure)
    assert len(pose.octaves) > 1 and calls == [model]
    more = model.with_views([*model.views, rendered.views[NIGHT]]).in_octave(2)
    np.testing.assert_array_equal(structure.normals, normals(more, neighbours=16))


def test_what_a_view_shows_are_points_of_the_structure(rendered):
    """The left half of a photo could show the last of them only."""
    structure, view = structure_of(rendered), rendered.views[NIGHT]
    points = structure.model.tracks.points
    at = view.project(points)[0]
    structure = dataclasses.replace(structure, model=_ordered(structure.model, -at[:, 0]))
    narrow = dataclasses.replace(view, size=(SIZE[0] // 2, SIZE[1]))
    ((_, shown),) = structure.shown_from([narrow], 1)
    assert len(shown.rows) > 30 and shown.rows.min() > 0
    found = structure.model.tracks.points[shown.rows]
    assert np.linalg.norm(found - shown.points, axis=1).max() < 0.02


def _ordered(model: Model, by: np.ndarray) -> Model:
    """The same model with its points in another order."""
    return model.with_tracks(model.tracks.select_points(np.argsort(by)))
