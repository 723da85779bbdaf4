"""Laws of pairs that agree with a model or do not, and of second places, on rendered walls."""

import numpy as np
import pytest
from room_scene import SIZE, view_of
from wall_scene import (
    REFINEMENT,
    Scene,
    big_wall,
    cameras,
    matched,
    poster,
    repeated,
    scene,
    true_matches,
    twin_matches,
)

from jaxsfm.bench.synthetic import TexturedPlane, camera_matrix
from jaxsfm.bench.walls import shift, turn
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.tracks import Tracks
from jaxsfm.io.pairs import PairResult
from jaxsfm.sfm.check.check_model import pair_fits
from jaxsfm.sfm.check.pose_ambiguity import few_points, pose_ambiguities, pose_ambiguity
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.limits import CHECK, POSE_AMBIGUITY
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.fixed_structure import FixedStructure, ResectionMatches

NAMES = [f"{k}.png" for k in range(6)]
PAIR = (NAMES[0], NAMES[1])


def normals(model: Model) -> np.ndarray:
    return plane_geometry.normals(model, neighbours=REFINEMENT.neighbours)


def structure(seen: Scene) -> FixedStructure:
    return FixedStructure(seen.model, seen.images, REFINEMENT)


# -- pairs -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wall() -> Model:
    """Three views of a wall that fills their photos."""
    return scene([([big_wall()], cameras([-8.0, 0.0, 7.0]))]).model


def fit(model: Model, result: PairResult) -> float | None:
    return pair_fits(model, normals(model), {result.pair: result}, [result.pair]).get(result.pair)


def displaced(result: PairResult, px: float, share: float = 1.0) -> PairResult:
    """So many of the second keypoints that far to the side, all of them inside the photo."""
    xy = result.keypoints1.copy()
    moved = np.arange(len(xy)) % 100 < 100 * share
    xy[moved, 0] += np.where(xy[moved, 0] < SIZE[0] / 2, px, -px)
    return matched(result.pair, result.keypoints0, xy)


def test_all_matches_of_the_models_own_points_fit_at_any_working_size(wall):
    """Matches are in pixels of the photos, whatever the size at which a model is worked on."""
    for model in (wall, wall.in_octave(2)):
        matches = {
            r.pair: r for r in (true_matches(wall, a, b) for a, b in ((0, 1), (1, 2), (2, 0)))
        }
        fits = pair_fits(model, normals(model), matches, matches.keys())
        assert fits == dict.fromkeys(matches, 1.0) and len(fits) == 3


@pytest.mark.parametrize(("share", "fits"), [(1.0, 0.0), (0.5, 0.5), (0.25, 0.75)])
def test_matches_that_are_displaced_do_not_fit(wall, share, fits):
    result = displaced(true_matches(wall, 0, 1), 100.0, share)
    assert fit(wall, result) == pytest.approx(fits, abs=0.05)
    assert fit(wall, displaced(result, 3.0)) == pytest.approx(fits, abs=0.05)  # as at night


@pytest.mark.parametrize(
    ("count", "said"), [(CHECK.least_matches - 1, False), (CHECK.least_matches, True)]
)
def test_a_pair_with_few_matches_has_no_share(wall, count, said):
    assert (fit(wall, true_matches(wall, 0, 1, most=count)) is not None) == said


def test_only_asked_pairs_of_photos_in_the_model_have_a_share(wall):
    part, _ = wall.part({NAMES[0], NAMES[1]})
    matches = {r.pair: r for r in (true_matches(wall, 0, 1), true_matches(wall, 0, 2))}
    normal = normals(part)
    assert pair_fits(part, normal, matches, matches.keys()).keys() == {PAIR}
    assert pair_fits(part, normal, matches, []) == {}
    far = true_matches(wall, 0, 1)
    beside = matched(PAIR, far.keypoints0 + 5000, far.keypoints1 + 5000)
    assert fit(wall, beside) is None  # there is no surface of the model


def test_in_a_street_a_step_of_one_house_in_the_other_direction_does_not_fit():
    """Neither the rotation nor epipolar lines tell it from the right step."""
    step = 1.5
    views = [
        view_of(CameraPose(np.eye(3), np.asarray([x, 0.0, -4.0])), k)
        for k, x in ((0, 0), (1, step))
    ]
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform((-2, -1.4), (4, 1.4), (600, 2)), np.zeros(600)]

    def seen(view, points):
        xy, _ = view.project(points)
        return xy, ((xy > 0) & (xy < np.asarray(SIZE) - 1)).all(1)

    parts = [seen(view, points) for view in views]
    point, view = np.nonzero(np.stack([inside for _, inside in parts], 1))
    xy = np.asarray([parts[v][0][p] for p, v in zip(point, view, strict=True)])
    street = Model(views, Tracks(points, point, view, xy))

    def pair(houses: int) -> PairResult:
        """The second photo takes each house for the one so many houses further."""
        other, inside = seen(views[1], points + [houses * step, 0, 0])
        both = inside & parts[0][1]
        assert both.sum() > 50
        return matched(PAIR, parts[0][0][both], other[both])

    k = np.linalg.inv(camera_matrix(SIZE))
    cross = np.asarray([[0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the baseline is the x axis
    for houses, fits in ((0, 1.0), (2, 0.0)):
        result = pair(houses)
        rays = [np.c_[xy, np.ones(len(xy))] @ k.T for xy in (result.keypoints0, result.keypoints1)]
        assert np.abs(np.einsum("ni,ij,nj->n", rays[1], cross, rays[0])).max() < 1e-6
        assert fit(street, result) == fits


# -- second places ---------------------------------------------------------------------------------

TURNED = turn(np.radians(70))._replace(translation=np.asarray([30.0, 0.0, 5.0]))
ASIDE = shift(30.0)


def two_walls(
    motion: Similarity,
    *,
    first: tuple[TexturedPlane, ...] = (),
    second: tuple[TexturedPlane, ...] = (),
) -> Scene:
    """Two equal walls with three views each, and what hangs on either of them."""
    wall = big_wall()
    return scene(
        [
            ([wall, *first], cameras([-8.0, 0.0, 7.0])),
            (
                [repeated(each, motion) for each in (wall, *second)],
                cameras([-5.0, 2.0, 9.0], motion=motion),
            ),
        ]
    )


@pytest.fixture(scope="module")
def equal() -> Scene:
    """Two equal walls at an angle."""
    return two_walls(TURNED)


def refused(*results: PairResult) -> ResectionMatches:
    return ResectionMatches({result.pair: result for result in results}, 0)


def places(seen: Scene, against: ResectionMatches):
    return pose_ambiguities(structure(seen), against)


@pytest.mark.parametrize(("motion", "turned_deg"), [(TURNED, 70.0), (ASIDE, 0.0)])
def test_a_view_that_fits_in_front_of_an_equal_wall_has_a_second_place(motion, turned_deg):
    """So does each view of the other wall, by the same pairs."""
    seen = two_walls(motion)
    against = refused(*(twin_matches(seen.model, 0, k, motion) for k in (4, 3)))
    found = places(seen, against)
    assert [(place.image, place.pairs) for place in found] == [
        (NAMES[0], [NAMES[3], NAMES[4]]),
        (NAMES[3], [NAMES[0]]),
        (NAMES[4], [NAMES[0]]),
    ]
    for place in found:
        assert place.rotation_deg == pytest.approx(turned_deg, abs=0.1)
        assert place.contradicted == 0 and place.agreed > 200


@pytest.mark.parametrize("hung", ["first", "second"])
def test_a_poster_on_one_of_two_equal_walls_tells_the_places_apart(hung):
    """It covers a ninth of the wall; it is on the view's own wall or on the other one."""
    seen = two_walls(TURNED, **{hung: (poster(3),)})
    assert len(set(seen.plane)) == 3
    against = refused(*(twin_matches(seen.model, 0, k, TURNED) for k in (3, 4)))
    assert places(seen, against) == []


def test_the_same_poster_on_both_walls_tells_nothing():
    seen = two_walls(TURNED, first=(poster(3),), second=(poster(3),))
    against = refused(twin_matches(seen.model, 0, 3, TURNED))
    assert [place.image for place in places(seen, against)] == [NAMES[0], NAMES[3]]


def test_matches_that_put_a_view_where_it_is_give_no_second_place(equal):
    seen = equal
    against = refused(true_matches(seen.model, 0, 1), true_matches(seen.model, 0, 2))
    assert places(seen, against) == [] and places(seen, refused()) == []


@pytest.mark.parametrize(
    ("count", "found"),
    [(POSE_AMBIGUITY.least_inliers - 1, 0), (POSE_AMBIGUITY.least_inliers + 5, 1)],
)
def test_few_matches_give_no_second_place(equal, count, found):
    seen = equal
    twins = twin_matches(seen.model, 0, 3, TURNED)
    few = matched(twins.pair, twins.keypoints0[:count], twins.keypoints1[:count])
    whole = structure(seen)
    view = (whole, few_points(whole), refused(few))
    assert sum(pose_ambiguity(*view, k) is not None for k in (0, 3)) == 2 * found


@pytest.mark.parametrize(
    ("points", "found"),
    [
        (POSE_AMBIGUITY.least_agreed - 5, False),
        (POSE_AMBIGUITY.least_agreed + 60, True),
    ],
)
def test_a_place_from_which_few_points_are_seen_is_no_second_place(equal, points, found):
    """All matches agree in it; that is not enough."""
    rows = np.flatnonzero((equal.plane == 0) | (np.cumsum(equal.plane == 1) <= points))
    few = equal._replace(model=equal.model.with_tracks(equal.model.tracks.select_points(rows)))
    against = refused(twin_matches(equal.model, 0, 3, TURNED))
    whole = structure(few)
    place = pose_ambiguity(whole, few_points(whole), against, 0)
    assert (place is not None) == found


def test_matches_with_another_wall_give_no_second_place():
    """They agree in a pose; the photo shows something else there."""
    wall, other = big_wall(), big_wall(7)
    seen = scene(
        [
            ([wall], cameras([-8.0, 0.0, 7.0])),
            ([repeated(other, TURNED)], cameras([-5.0, 2.0, 9.0], motion=TURNED)),
        ]
    )
    assert places(seen, refused(twin_matches(seen.model, 0, 3, TURNED))) == []
