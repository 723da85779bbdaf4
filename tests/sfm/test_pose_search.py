"""Laws of the search around poses: a photo of which only a corner is lit."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from room_scene import SIZE, Room, exact_model, images_of
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine import octave_pose, pose_search
from jaxsfm.sfm.refine.octave_pose import AlignedPoints, OctavePose, PoseHypothesis, follow, trusted
from jaxsfm.sfm.refine.pose_search import BESIDE, MIN_PATCHES, STANDS_OUT, search

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


def turned(view: View, degrees: float) -> View:
    turn = Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    return dataclasses.replace(view, rotation=turn @ view.rotation)


def followed(scene: Room, degrees: float) -> PoseHypothesis:
    """A start that is turned, followed and searched around."""
    pose = PoseHypothesis(view=turned(scene.views[NIGHT], degrees), own_camera=False)
    structure, images = by_day(scene), images_of(scene)
    follow([pose], structure, images, REFINEMENT)
    search([pose], structure, images, REFINEMENT)
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
    follow([alone], by_day(scene), images_of(scene), REFINEMENT)
    assert not alone.octaves
    found = trusted(followed(scene, 2.0))
    assert found is not None and off_px(found.view, scene) < 0.5


@pytest.mark.parametrize("degrees", [6.0, 25.0])
def test_a_pose_far_from_where_anything_agrees_is_not_trusted(rendered, degrees, much_is_asked):
    pose = followed(lit_in_a_corner(rendered), degrees)
    assert trusted(pose) is None and pose.stands_out is None


def test_what_a_descent_found_is_forgotten_when_a_pose_climbs_away(rendered, monkeypatch):
    view = rendered.views[NIGHT]
    stale = _octave(view, 1, doubt_px=0.1)
    pose = PoseHypothesis(view=view, own_camera=False, octaves={1: stale}, share=0.9)
    counts = {0: 31, 1: 35}  # of the pose itself, and of the first one beside it

    def settle(tried, *_):
        for k, each in enumerate(tried):
            each.agreed = counts.get(k, 0)

    monkeypatch.setattr(pose_search, "settle", settle)
    monkeypatch.setattr(pose_search, "follow", lambda moved, *_: None)
    search([pose], by_day(rendered), images_of(rendered), REFINEMENT)
    assert pose.octaves == {} and pose.share == 0.0 and pose.view is not view


@pytest.mark.parametrize(
    ("own", "beside", "climbs"), [(31, 34, False), (31, 35, True), (0, 30, False), (0, 31, True)]
)
def test_a_pose_climbs_only_for_a_tenth_more_and_enough(rendered, monkeypatch, own, beside, climbs):
    pose = PoseHypothesis(view=rendered.views[NIGHT], own_camera=False)
    counts = [own, *[0] * 4, beside, 0, 0, 0]

    def settle(tried, *_):
        for each, count in zip(tried, counts, strict=True):
            each.agreed = count
        counts[:] = [99, *[0] * 8]  # the next step stays

    monkeypatch.setattr(pose_search, "settle", settle)
    moved = pose_search._climb([pose], by_day(rendered), images_of(rendered), REFINEMENT)
    assert bool(moved) is climbs
    # The fifth of eight directions is opposite to the first: the photo's middle moves to the left.
    way = pose.view.project(rendered.points)[0] - rendered.views[NIGHT].project(rendered.points)[0]
    side = 2 * REFINEMENT.radius + 1
    assert np.median(way[:, 0]) == pytest.approx(-side if climbs else 0, abs=0.1 * side)


def _octave(view: View, px: int, *, doubt_px: float, patches: int = MIN_PATCHES) -> OctavePose:
    return OctavePose(view, px, AlignedPoints.joined([]), 40, 1.0, doubt_px, patches)


@pytest.mark.parametrize(
    ("beside", "patches", "right"),
    [(8, 20, True), (9, 20, False), (0, 20, True), (8, 19, False)],
)
def test_a_pose_stands_out_with_five_times_what_is_beside_it_in_enough_patches(
    rendered, monkeypatch, beside, patches, right
):
    view = rendered.views[NIGHT]
    assert STANDS_OUT * 8 == 40
    one = _octave(view, 2, doubt_px=9.0, patches=patches)
    ways = []

    def shown_from(views, *_):
        middle = view.centre + 5 * view.rotation[2]
        ways.extend(
            each.project(middle[None])[0][0] - view.project(middle[None])[0][0] for each in views
        )
        counts = [0, 0, beside, 0]
        return [
            (each, SimpleNamespace(rows=range(n))) for each, n in zip(views, counts, strict=True)
        ]

    monkeypatch.setattr(pose_search, "shown_from", shown_from)
    pose = PoseHypothesis(view=view, own_camera=False, octaves={2: one})
    pose_search._compare([pose], by_day(rendered), images_of(rendered), REFINEMENT)
    assert pose.stands_out is (one if right else None)
    far = BESIDE * 2 * (2 * REFINEMENT.radius + 1)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), far, rtol=0.1)


@pytest.mark.parametrize(
    ("beside", "best"), [({}, 1), ({1: 9}, 2), ({1: 9, 2: 9}, 4), ({4: 9}, None)]
)
def test_the_coarsest_octave_stands_out_and_of_those_that_do_the_surest_counts(
    rendered, monkeypatch, beside, best
):
    view = rendered.views[NIGHT]
    doubts = {4: 1.5, 2: 1.2, 1: 0.9}
    octaves = {px: _octave(view, px, doubt_px=doubt) for px, doubt in doubts.items()}

    def shown_from(views, structure, images, refinement, px):
        return [(each, SimpleNamespace(rows=range(beside.get(px, 0)))) for each in views]

    monkeypatch.setattr(pose_search, "shown_from", shown_from)
    for order in ((4, 2, 1), (1, 2, 4)):
        own = {px: octaves[px] for px in order}
        pose = PoseHypothesis(view=view, own_camera=False, octaves=own)
        three = Refinement(weak_octaves=3)
        pose_search._compare([pose], by_day(rendered), images_of(rendered), three)
        assert pose.stands_out is (octaves[best] if best else None)


def test_after_a_search_a_pose_has_to_stand_out(rendered):
    view = rendered.views[NIGHT]
    sure = _octave(view, 1, doubt_px=0.1)
    pose = PoseHypothesis(view=view, own_camera=False, octaves={1: sure}, share=0.9)
    assert trusted(pose) is sure
    assert trusted(dataclasses.replace(pose, searched=True)) is None
    for doubt_px, right in ((2.0, True), (2.01, False)):
        found = _octave(view, 2, doubt_px=doubt_px)
        after = dataclasses.replace(pose, searched=True, stands_out=found, share=0.01)
        assert trusted(after) is (found if right else None)
