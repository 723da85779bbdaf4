"""Laws of how far views agree, on rendered walls with exact cameras and pixels."""

import numpy as np
import pytest
from room_scene import exact_model, images_of, other_scene
from wall_scene import (
    DISTANCE,
    REFINEMENT,
    Scene,
    big_wall,
    cameras,
    picture,
    poster,
    scene,
)

from jaxsfm.sfm.check import agreement as module
from jaxsfm.sfm.check.agreement import (
    MAX_ANGLE_DEG,
    MAX_DISTANCE_RATIO,
    MIN_COMPARED,
    Agreement,
    agreement,
)

ANGLES = [-10.0, -4.0, 3.0, -7.0, 0.0, 8.0]
HALF = 3
"""The first views see one poster, the others another one."""


def agreement_of(seen: Scene, targets: list[int] | None = None) -> Agreement:
    return agreement(seen.model, seen.images, REFINEMENT, targets=targets)


@pytest.fixture(scope="module")
def halves() -> Scene:
    """Two walls with different posters, taken for one wall."""
    wall = big_wall()
    return scene(
        [
            ([wall, poster(1)], cameras(ANGLES[:HALF])),
            ([wall, poster(2)], cameras(ANGLES[HALF:])),
        ]
    )


def test_in_an_exact_scene_no_view_contradicts_another_and_all_are_compared():
    seen = scene([([big_wall(), poster(1)], cameras(ANGLES))])
    found = agreement_of(seen)
    others = ~np.eye(len(ANGLES), dtype=bool)
    assert not found.contradicted.any() and not found.tested[~others].any()
    per_view = np.bincount(seen.model.tracks.view)
    assert (found.tested[others] > 0.5 * per_view.min()).all()
    assert (found.tested <= per_view.max()).all()


def test_the_rendered_room_contradicts_itself_nowhere(rendered):
    """Its board hides other parts of the walls from every view."""
    found = agreement(exact_model(rendered), images_of(rendered), REFINEMENT)
    assert not found.contradicted.any() and (found.tested > 100).sum() >= 10


def test_halves_with_different_posters_contradict_each_other_in_both_directions(halves):
    found = agreement_of(halves)
    first = np.arange(len(ANGLES)) < HALF
    across = first[:, None] != first
    assert not found.contradicted[~across].any()
    for a, b in zip(*np.nonzero(across), strict=True):
        own = np.unique(halves.model.tracks.point[halves.model.tracks.view == a])
        on_poster = int((halves.plane[own] == (1 if first[a] else 2)).sum())
        assert 0.5 * on_poster < found.contradicted[a, b] <= on_poster


def test_a_view_that_has_no_part_in_the_model_can_be_compared_with_it(halves):
    """What others see is known from their tracks; what it shows is found. It contradicts nearly as
    many points as if it had a part in the model."""
    every = agreement_of(halves)
    for k in (1, 4):
        model = halves.model.select(halves.model.tracks.view != k)
        alone = agreement(model, halves.images, REFINEMENT, targets=[k])
        assert not np.delete(alone.tested, k, 1).any()
        assert (np.delete(alone.tested[:, k], k) > 300).all()
        across = (np.arange(len(ANGLES)) < HALF) != (k < HALF)
        assert (alone.contradicted[across, k] > 0.8 * every.contradicted[across, k]).all()
        assert not alone.contradicted[~across, k].any()


def test_a_photo_of_something_else_contradicts_what_it_is_tested_on(halves):
    """What it observed before, when it was another photo, does not speak for it."""
    name = halves.names[4]
    elsewhere = halves._replace(photos=halves.photos | {name: other_scene(0)})
    found = agreement_of(elsewhere, targets=[4])
    assert found.contradicted.sum() > 0.9 * found.tested.sum() > 500


def test_of_patches_that_agree_a_little_nothing_is_said():
    """Noise over a photo takes most correlations to about 0.65: less than what agrees, more than
    what shows something else."""
    seen = scene([([big_wall()], cameras(ANGLES))])
    name, k = seen.names[4], 4
    model = seen.model.select(seen.model.tracks.view != k)
    photo = seen.photos[name]
    spread = [
        photo[y : y + 15, x : x + 15].std() for y in range(0, 340, 50) for x in range(0, 460, 70)
    ]
    for factor, blank in ((1.2, False), (20.0, True)):
        noise = np.random.default_rng(0).normal(0, factor * np.median(spread), photo.shape)
        images = seen._replace(photos=seen.photos | {name: photo + noise.astype(np.float32)}).images
        found = agreement(model, images, REFINEMENT, targets=[k])
        assert (found.contradicted.sum() > 1000) == blank
        assert (found.tested[0, k] > 250) == blank


def test_a_change_of_light_contradicts_little_and_another_photo_much(halves):
    """Noise takes most correlations below what agrees, as shadows do that have moved. A photo of
    something else has few correlations just below what agrees."""
    seen = scene([([big_wall()], cameras(ANGLES))])
    name, k = seen.names[4], 4
    photo = seen.photos[name]
    noise = np.random.default_rng(0).normal(0, 1.3 * photo.std(), photo.shape)
    shares = {}
    for label, taken in (("light", photo + noise), ("other", other_scene(0))):
        changed = seen._replace(photos=seen.photos | {name: taken.astype(np.float32)})
        found = agreement_of(changed, targets=[k])
        tested, contradicted, beyond = (
            each[:, k].sum() for each in (found.tested, found.contradicted, found.beyond_light())
        )
        assert contradicted > 0.3 * tested > 100
        shares[label] = beyond / contradicted
    assert shares["light"] < 0.4 and shares["other"] > 0.8


def test_points_that_something_in_front_hides_are_no_contradictions(monkeypatch):
    """A pillar hides another part of the wall from every view."""
    pillar = picture(5, left=-0.4, width=0.8, height=2.0, z=-1.5)
    seen = scene([([big_wall(), pillar], cameras(ANGLES))])
    assert not agreement_of(seen).contradicted.any()
    monkeypatch.setattr(module, "_not_hidden", lambda view, *_: np.ones(len(_[-1]), bool))
    assert agreement_of(seen).contradicted.sum() > 200  # if nobody asks what is in front


def test_a_thing_that_stands_before_one_view_alone_contradicts_nothing():
    wall, passer_by = big_wall(), picture(5, left=-0.4, width=0.8, height=2.0, z=-1.5)
    seen = scene([([wall], cameras(ANGLES[:-1])), ([wall, passer_by], cameras(ANGLES[-1:]))])
    assert set(seen.plane) == {0}
    found, without = agreement_of(seen), agreement_of(scene([([wall], cameras(ANGLES))]))
    hidden = (without.tested - found.tested)[:-1, -1]
    assert (hidden > 50).all() and (found.contradicted[:-1, -1] < 0.1 * hidden).all()
    assert not found.contradicted[-1].any()


def test_only_views_that_look_from_nearly_the_same_side_are_compared():
    angles = np.asarray([-40.0, -20.0, 0.0, 20.0, 40.0])
    seen = scene([([big_wall()], cameras(list(angles)))])
    tested = agreement_of(seen).tested
    apart = np.abs(angles[:, None] - angles)
    assert (tested[apart == 20] >= MIN_COMPARED).all() and 20 < MAX_ANGLE_DEG < 40
    assert not tested[apart >= 40].any()


def test_only_views_from_nearly_the_same_distance_are_compared():
    near, middle, far = DISTANCE, 1.35 * DISTANCE, 1.82 * DISTANCE
    poses = [cameras([angle], distance=d)[0] for angle, d in ((-5, near), (0, middle), (5, far))]
    tested = agreement_of(scene([([big_wall()], poses)])).tested
    # Most patches are those of the view in the middle. They are tested in the other two only.
    assert tested[1, 0] > 300 and tested[1, 2] > 300
    assert not tested[0, 2] and not tested[2, 0] and 1.35 < MAX_DISTANCE_RATIO < 1.82


def test_single_failures_here_and_there_do_not_count(halves):
    """As many points fail as with a poster, but no two of them are neighbours."""
    seen = scene([([big_wall()], cameras(ANGLES))])
    changed, tracks, rng = 4, seen.model.tracks, np.random.default_rng(0)
    xy = tracks.xy[tracks.view == changed]
    chosen: list[np.ndarray] = []
    for at in xy[rng.permutation(len(xy))]:
        if all(np.abs(at - other).max() > 40 for other in chosen):
            chosen.append(at)
    photo = seen.photos[seen.names[changed]].copy()
    for x, y in np.round(chosen).astype(int):
        spot = photo[y - 9 : y + 10, x - 9 : x + 10]
        spot[:] = rng.uniform(0, 255, spot.shape)
    spotted = seen._replace(photos=seen.photos | {seen.names[changed]: photo})
    assert len(chosen) > 30
    assert not agreement_of(spotted).contradicted.any()
    assert agreement_of(halves).contradicted[0, changed] > 20
