"""Laws of models that are joined again."""

import dataclasses

import numpy as np
import pytest
from room_scene import SIZE, arrays, errors, exact_model
from scipy.spatial.transform import Rotation
from strategies import rng_of
from wall_scene import big_wall, cameras, poster, scene, true_matches

from jaxsfm.colmap.mapper import MapOptions, registered
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.config import Config, Refinement
from jaxsfm.sfm import checker as checker_module
from jaxsfm.sfm import rejoined as module
from jaxsfm.sfm.checker import Checker, VerifiedPairs
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.rejoined import Part, rejoined
from jaxsfm.sfm.robust_similarity import robust_similarity

OPTIONS = MapOptions(refine_intrinsics=False, threads=1)
MOTION = Similarity(
    2.5,
    Rotation.from_euler("xyz", [20, -70, 40], degrees=True).as_matrix(),
    np.asarray([3.0, 1, 7]),
)
NAMES = [f"{k}.png" for k in range(5)]


class Photos:
    """As much of a run's photos as a check needs."""

    def __init__(self, photos) -> None:
        self.gray = lambda name: (photos[name], (1.0, 1.0))

    def working_size(self, name):
        return SIZE, (1.0, 1.0)


def moved(model: Model, motion: Similarity) -> Model:
    views = []
    for view in model.views:
        pose = motion.moved(CameraPose(view.rotation, view.centre))
        views.append(dataclasses.replace(view, rotation=pose.rotation, centre=pose.centre))
    points = motion.apply(model.tracks.points)
    return Model(views, model.tracks._replace(points=points), model.cameras)


def parts_of(model: Model, photos, first, second, *, most=None):
    """Two parts of a model, the second in a frame of its own; a checker; the pairs asked for."""
    names = [view.name for view in model.views]
    matches = {}
    for a in range(len(names)):
        for b in range(a + 1, len(names)):
            found = true_matches(model, a, b, most=most)
            matches[found.pair] = found
    given = VerifiedPairs(
        None,  # pyright: ignore[reportArgumentType]
        dict.fromkeys(matches),  # pyright: ignore[reportArgumentType]
        matches,
        Photos(photos),  # pyright: ignore[reportArgumentType]
    )
    config = Config(checked=True, refinement=Refinement())
    checker = Checker(given, config, 0, lambda one: one)
    models = [
        model.part(set(first))[0].to_colmap(),
        moved(model.part(set(second))[0], MOTION).to_colmap(),
    ]
    asked = []

    def with_points(one, pairs):
        asked.append(set(pairs))
        return one

    parts = [
        Part(one, done) for one, done in zip(models, checker.check(models, ()), strict=True) if done
    ]
    assert len(parts) == 2
    return parts, checker, with_points, asked


def test_two_parts_of_a_room_become_the_room(rendered):
    """They share no photo, and the matches between them alone say how they belong together."""
    model = exact_model(rendered)
    few = dataclasses.replace(model, views=model.views)
    parts, checker, with_points, asked = parts_of(
        few, rendered.images, NAMES[:3], NAMES[2:], most=400
    )
    (whole,) = rejoined(parts, checker, with_points, OPTIONS)
    assert registered(whole.model) == {*NAMES} and max(errors(whole.model, rendered)) < 0.01
    assert whole.done.check.verdict == "green" and whole.done.check.groups == [NAMES]
    (pairs,) = asked
    assert {("0.png", "3.png"), ("0.png", "4.png"), ("1.png", "3.png")} <= pairs
    assert arrays(whole.model, rendered).errors_px().max() < 1.0


@pytest.fixture(scope="module")
def walls():
    """Two walls with different posters, taken for one; three photos of each."""
    wall = big_wall()
    angles = [-10.0, -4.0, 3.0, -7.0, 0.0, 8.0]
    return scene(
        [([wall, poster(1)], cameras(angles[:3])), ([wall, poster(2)], cameras(angles[3:]))]
    )


def test_parts_that_contradict_each_other_stay_apart(walls):
    """The matches on the wall put them into one place, where their posters differ."""
    parts, checker, with_points, asked = parts_of(
        walls.model, walls.photos, walls.names[:3], walls.names[3:]
    )
    found = rejoined(parts, checker, with_points, OPTIONS)
    assert {id(part) for part in found} == {id(part) for part in parts} and asked


def test_parts_without_enough_matches_between_them_are_not_tried(rendered):
    model = exact_model(rendered)
    parts, checker, with_points, asked = parts_of(
        model, rendered.images, NAMES[:3], NAMES[2:], most=400
    )
    few = {p: r for p, r in checker.given.matches.items() if len({*p} & {*NAMES[:2]}) != 1}
    lonely = checker._replace(given=checker.given._replace(matches=few, two_views=few))
    assert len(rejoined(parts, lonely, with_points, OPTIONS)) == 2 and not asked


@pytest.mark.parametrize("first", [2, 3])
def test_parts_in_which_no_photos_agree_stay_apart(rendered, monkeypatch, first):
    """The check finds no contradiction, but no group with photos of both either. The photo 2.png,
    which is in both parts, does not count."""
    model = exact_model(rendered)
    parts, checker, with_points, asked = parts_of(
        model, rendered.images, NAMES[:3], NAMES[2:], most=400
    )
    check = checker_module.check_model

    def silent(*arguments):
        done = check(*arguments)
        groups = [NAMES[:first], NAMES[first:]]
        return done._replace(check=dataclasses.replace(done.check, groups=groups))

    monkeypatch.setattr(checker_module, "check_model", silent)
    assert len(rejoined(parts, checker, with_points, OPTIONS)) == 2 and asked


@pytest.mark.parametrize("flat", [False, True])
def test_a_similarity_is_found_among_false_matches_also_on_a_plane(flat):
    rng = rng_of(0)
    source = rng.uniform(-5, 5, (300, 3)) * [1, 1, 0 if flat else 1]
    target = MOTION.apply(source) + rng.normal(0, 0.01, source.shape)
    false = rng.permutation(300)[:200]
    target[false] = rng.uniform(-20, 20, (200, 3))
    found = robust_similarity(source, target, max_error=0.1, seed=1)
    right = np.setdiff1d(np.arange(300), false)
    assert found.inliers[right].all() and found.inliers.sum() <= 105
    np.testing.assert_allclose(found.similarity.apply(source), MOTION.apply(source), atol=0.02)
    again = robust_similarity(source, target, max_error=0.1, seed=1)
    np.testing.assert_array_equal(found.inliers, again.inliers)


def test_fewer_than_three_matches_are_refused():
    with pytest.raises(ValueError, match=r"n >= 3; got \(2, 3\)"):
        robust_similarity(np.zeros((2, 3)), np.zeros((2, 3)), max_error=1.0, seed=0)
    with pytest.raises(ValueError, match=r"\(3, 3\) and \(4, 3\)"):
        robust_similarity(np.zeros((3, 3)), np.zeros((4, 3)), max_error=1.0, seed=0)


def test_a_second_similarity_is_that_of_the_matches_that_the_first_leaves():
    rng = rng_of(3)
    source = rng.uniform(-5, 5, (160, 3))
    other = Similarity(1.0, np.eye(3), np.asarray([30.0, 0, 0]))
    target = np.where(np.arange(160)[:, None] < 100, MOTION.apply(source), other.apply(source))
    order = rng.permutation(160)
    same = np.stack([np.arange(160), order], axis=1)
    moved = np.empty_like(source)
    moved[order] = source
    found = list(module._similarities(seen_by_one(target), seen_by_one(moved), same, 0))
    assert len(found) == 2
    for way, own in zip(found, (np.arange(100), np.arange(100, 160)), strict=True):
        np.testing.assert_array_equal(way.same, same[own])
        np.testing.assert_allclose(way.similarity.apply(source[own]), target[own], atol=1e-6)


def seen_by_one(points: np.ndarray) -> Model:
    """A view that observes all points."""
    seen = scene([([big_wall()], cameras([0.0, 5.0]))]).model
    tracks = seen.tracks._replace(
        points=points,
        point=np.arange(len(points)),
        view=np.zeros(len(points), int),
        xy=np.zeros((len(points), 2)),
    )
    return Model(seen.views, tracks)


def test_points_that_matches_join_are_the_same_whichever_photo_has_the_first_name(rendered):
    model = exact_model(rendered)
    parts, checker, _, _ = parts_of(model, rendered.images, NAMES[:3], NAMES[2:])
    one, other = (module._open(checker, part) for part in parts)
    given = checker.given
    same = module._same_points(one, other, given.matches, given.two_views)
    assert len(same) > 100
    back = module._same_points(other, one, given.matches, given.two_views)
    assert set(map(tuple, same.tolist())) == set(map(tuple, back[:, ::-1].tolist()))
    here, there = one.model.tracks.points[same[:, 0]], other.model.tracks.points[same[:, 1]]
    np.testing.assert_allclose(MOTION.apply(here), there, atol=1e-6)


def test_what_was_joined_wrongly_by_some_percent_is_pulled_together(rendered):
    """The second part is bent: its cameras and points are 3 % off along one axis."""
    model = exact_model(rendered)
    parts, checker, with_points, _ = parts_of(model, rendered.images, NAMES[:3], NAMES[2:])
    bent, _ = module.opened(parts[1].model, checker.given.photos)
    stretch = np.diag([1.03, 1.0, 1.0])
    views = [dataclasses.replace(view, centre=stretch @ view.centre) for view in bent.views]
    points = bent.tracks.points @ stretch
    wrong = Model(views, bent.tracks._replace(points=points), bent.cameras).to_colmap()
    parts[1] = parts[1]._replace(model=wrong)
    (whole,) = rejoined(parts, checker, with_points, OPTIONS)
    assert max(errors(whole.model, rendered)) < 0.01
