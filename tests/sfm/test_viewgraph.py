"""Laws of the view graph: which pairs are trusted."""

import itertools
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from oracles import grown_rotations
from scipy.spatial.transform import Rotation
from strategies import rng_of, seeds

from jaxsfm.colmap.two_views import PairGeometry, spread
from jaxsfm.io.pairs import component_of
from jaxsfm.sfm import view_graph
from jaxsfm.sfm.limits import TRUST
from jaxsfm.sfm.view_graph import edge_weights, mean_rotation, rotation_angle_deg, trusted_pairs


def ring(rng, count=8, *, noise_deg=0.5):
    """Cameras in a ring, each matched with its neighbours; true rotations and geometries."""
    rotations = [
        Rotation.from_euler("y", 360 * k / count, degrees=True)
        * Rotation.from_rotvec(rng.normal(0, 0.05, 3))
        for k in range(count)
    ]
    names = [f"{k}.jpg" for k in range(count)]
    pairs = {}
    for i, j in itertools.combinations(range(count), 2):
        apart = min(j - i, count - (j - i))
        if apart > 2:
            continue
        noise = Rotation.from_rotvec(np.radians(rng.normal(0, noise_deg, 3)))
        relative = noise * rotations[j] * rotations[i].inv()
        pairs[names[i], names[j]] = PairGeometry(
            num_inliers=int(rng.integers(800, 2000) / apart), rotation=relative.as_matrix()
        )
    return names, rotations, pairs


def false_pair(rng, inliers: int) -> PairGeometry:
    """A facade taken for its likeness on the opposite side."""
    turn = Rotation.from_euler("y", rng.uniform(60, 180), degrees=True)
    return PairGeometry(num_inliers=inliers, rotation=turn.as_matrix())


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_true_pairs_stay_and_weaker_false_ones_go(seed):
    rng = rng_of(seed)
    names, rotations, pairs = ring(rng)
    false = {}
    for k in range(4):  # consistent with each other, as repeated facades are
        pair = (names[k], names[k + 4])
        relative = rotations[k + 4] * rotations[k].inv()
        turned = Rotation.from_euler("y", 120, degrees=True) * relative
        false[pair] = PairGeometry(num_inliers=150, rotation=turned.as_matrix())
    verdicts = trusted_pairs(pairs | false)
    assert {p for p, v in verdicts.items() if v.trusted} == set(pairs)
    for pair in false:
        assert "deg" in verdicts[pair].reason and verdicts[pair].rotation_error_deg > 15


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_verdicts_depend_neither_on_the_order_nor_on_the_names_of_images(seed):
    rng = rng_of(seed)
    names, _, pairs = ring(rng)
    pairs[names[0], names[4]] = false_pair(rng, 100)
    one = trusted_pairs(pairs)
    shuffled = list(pairs.items())
    rng.shuffle(shuffled)
    again = trusted_pairs(dict(shuffled))
    assert one == again
    renamed = dict(zip(names, rng.permutation([f"x{k}" for k in range(len(names))]), strict=True))
    other = {}
    for (a, b), g in pairs.items():
        x, y = str(renamed[a]), str(renamed[b])
        rotation = g.rotation if x < y else g.rotation.T
        other[min(x, y), max(x, y)] = PairGeometry(num_inliers=g.num_inliers, rotation=rotation)
    moved = trusted_pairs(other)
    for (a, b), verdict in one.items():
        x, y = sorted((str(renamed[a]), str(renamed[b])))
        assert moved[x, y].trusted == verdict.trusted


def two_groups(joining, turned):
    """The pairs of two groups of three images that are not trusted.

    Pairs between the groups have so many inliers, by pair, and pairs within a group have 1000. The
    `turned` ones agree that the second group is turned by half a turn.
    """
    rng = rng_of(3)
    rotations = [Rotation.from_rotvec(rng.normal(0, 0.3, 3)) for _ in range(6)]
    half_turn = Rotation.from_euler("y", 180, degrees=True)
    inside = [p for group in ("abc", "def") for p in itertools.combinations(group, 2)]
    pairs = {}
    for pair, inliers in {**dict.fromkeys(inside, 1000), **joining}.items():
        i, j = ("abcdef".index(name) for name in pair)
        turn = half_turn if pair in turned else Rotation.identity()
        relative = rotations[j] * turn * rotations[i].inv()
        pairs[pair] = PairGeometry(num_inliers=inliers, rotation=relative.as_matrix())
    return {pair for pair, verdict in trusted_pairs(pairs).items() if not verdict.trusted}


def test_groups_meet_where_most_inliers_agree():
    """Two groups joined by one strong false pair and three true ones that together outweigh it."""
    true = dict.fromkeys([("a", "d"), ("b", "e"), ("c", "f")], 300)
    assert two_groups({**true, ("a", "e"): 380}, {("a", "e")}) == {("a", "e")}


def test_one_strong_pair_outweighs_several_weak_ones():
    """Windows that look the same give many weak pairs that agree with each other."""
    false = dict.fromkeys([("a", "d"), ("b", "e"), ("c", "f")], 150)
    assert two_groups({**false, ("a", "e"): 400}, false.keys()) == false.keys()


def test_one_strong_pair_outweighs_many_that_are_half_as_strong():
    """The two sides of a temple look alike: ten weak pairs agreed with each other."""
    false = dict.fromkeys(itertools.product("abc", "def"), 330)
    false.pop(("b", "e"))
    assert two_groups({**false, ("b", "e"): 800}, false.keys()) == false.keys()


@pytest.mark.parametrize(("inliers", "trusted"), [(20, False), (1500, True)])
def test_a_pair_that_alone_joins_an_image_to_others_has_to_be_strong(inliers, trusted):
    """Any rotation agrees with its own one. A night photo may still be registered later."""
    rng, alone = rng_of(0), ("0.jpg", "night.jpg")
    _, _, pairs = ring(rng)
    verdicts = trusted_pairs(pairs | {alone: false_pair(rng, inliers)})
    assert {pair for pair, verdict in verdicts.items() if verdict.trusted} == (
        pairs.keys() | ({alone} if trusted else set())
    )
    assert ("alone joins" in verdicts[alone].reason) == (not trusted)


def test_a_weak_pair_is_trusted_if_a_second_one_joins_the_same_groups():
    true = dict.fromkeys([("a", "d"), ("b", "e")], 60)
    assert two_groups(true, set()) == set()
    assert two_groups({("a", "d"): 60}, set()) == {("a", "d")}


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_bridges_are_the_pairs_without_which_a_group_falls_in_two(seed):
    """The oracle takes each pair away in turn."""
    rng = rng_of(seed)
    names = [f"{k}" for k in range(9)]
    every = [*itertools.combinations(names, 2)]
    pairs = [every[k] for k in rng.permutation(len(every))[: rng.integers(0, 14)]]
    expected = [(a, b) for a, b in sorted(pairs) if b not in component_of([a], {*pairs} - {(a, b)})]
    assert view_graph.bridges(pairs) == expected


def test_a_strong_pair_stays_whatever_its_rotation():
    """A facade's or a telephoto's rotation can be poor where its thousand matches are not."""
    rng = rng_of(1)
    names, _, pairs = ring(rng)
    turned = (
        Rotation.from_euler("x", 30, degrees=True).as_matrix() @ pairs[names[0], names[2]].rotation
    )
    for inliers, stays in ((1000, True), (40, False)):
        pairs[names[0], names[2]] = PairGeometry(num_inliers=inliers, rotation=turned)
        verdict = trusted_pairs(pairs)[names[0], names[2]]
        assert verdict.trusted == stays and verdict.rotation_error_deg > 15


def test_a_strong_pair_needs_a_right_rotation_only_where_it_is_asked_for():
    """Photos of equal walls may be a strong pair, and turned against all others."""
    rng = rng_of(1)
    names, _, pairs = ring(rng)
    false = (names[0], names[2])
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    pairs[false] = PairGeometry(num_inliers=1000, rotation=turn @ pairs[false].rotation)
    strict, default = trusted_pairs(pairs, strict=True), trusted_pairs(pairs)
    assert all(verdict.trusted for verdict in default.values())
    assert [pair for pair, verdict in strict.items() if not verdict.trusted] == [false]
    assert strict[false].edge_weight > TRUST.strong and "deg" in strict[false].reason
    assert not any(verdict.rejected for verdict in strict.values())


def test_pairs_for_which_something_else_speaks_are_joined_first():
    """A false pair of the ends of a row is the strongest. Joined first, it takes an end along."""
    names, turn = [*"abcdef"], Rotation.from_euler("y", 180, degrees=True).as_matrix()
    row, false = [*itertools.pairwise(names)], ("a", "f")
    weaker = dict.fromkeys([("a", "b"), ("a", "c")], 600)
    inliers = {**dict.fromkeys([*row, ("d", "f")], 700), **weaker, false: 800}
    pairs = {
        pair: PairGeometry(num_inliers=count, rotation=turn if pair == false else np.eye(3))
        for pair, count in inliers.items()
    }

    def dropped(first) -> set:
        verdicts = trusted_pairs(pairs, strict=True, first=first)
        return {pair for pair, verdict in verdicts.items() if not verdict.trusted}

    assert dropped(()) == weaker.keys() and dropped(row) == {false}
    assert dropped([*row, ("x", "y")]) == {false}  # a pair that is not there says nothing


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_groups_that_pairs_join_are_those_of_a_search_through_all_pairs(seed):
    """Groups of all sizes meet; four of ten pairs are false, and few vote, so it is close."""
    rng = rng_of(seed)
    names = [f"{k:02d}" for k in range(16)]
    rotations = dict(zip(names, Rotation.random(16, rng), strict=True))
    chosen = [p for p in itertools.combinations(names, 2) if rng.random() < 0.4]
    rng.shuffle(chosen)
    pairs = {}
    for a, b in map(tuple, chosen):
        turn = Rotation.from_rotvec([0, 2, 0]) if rng.random() < 0.4 else Rotation.identity()
        noise = Rotation.from_rotvec(rng.normal(0, 0.02, 3))
        pairs[a, b] = (noise * rotations[b] * turn * rotations[a].inv(), float(rng.uniform(1, 2)))
    votes = {pair: (rotation, weight**2) for pair, (rotation, weight) in pairs.items()}
    expected = grown_rotations(votes, 5, TRUST.rotation_deg)
    with mock.patch.object(view_graph, "MAX_VOTES", 5):
        found = view_graph._grow(
            list(pairs),
            {p: PairGeometry(num_inliers=1, rotation=r.as_matrix()) for p, (r, _) in pairs.items()},
            {p: vote for p, (_, vote) in pairs.items()},
        )
    assert sum(map(len, expected)) == len(found)
    for group in expected:
        worlds = [found[name].T @ rotation.as_matrix() for name, rotation in group.items()]
        np.testing.assert_allclose(worlds, worlds[:1] * len(worlds), atol=1e-9)


def test_many_pairs_between_two_groups_stay_cheap():
    """2 x 60 images: a vote of all 3600 pairs would hold gigabytes."""
    import tracemalloc

    rotation = np.eye(3)
    pairs = {}
    for i, j in itertools.combinations(range(120), 2):
        strong = (i < 60) == (j < 60)
        pairs[f"{i:03d}", f"{j:03d}"] = PairGeometry(
            num_inliers=1000 if strong else 100, rotation=rotation
        )
    tracemalloc.start()
    assert all(v.trusted for v in trusted_pairs(pairs).values())
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def test_pairs_without_a_pose_are_not_trusted_and_say_so():
    pairs = {
        ("a", "b"): PairGeometry(num_inliers=50, rotation=None),
        ("a", "c"): PairGeometry(num_inliers=0, rotation=np.eye(3)),
        ("b", "c"): PairGeometry(num_inliers=50, rotation=np.eye(3)),
    }
    verdicts = trusted_pairs(pairs)
    assert [v.trusted for v in verdicts.values()] == [False, False, True]
    assert verdicts["a", "b"].reason == "no relative pose"
    assert trusted_pairs({}) == {}


def test_edge_weight_is_relative_to_the_best_pairs_of_both_images_and_of_all_others():
    pairs = {
        ("a", "b"): PairGeometry(num_inliers=400, rotation=np.eye(3)),
        ("b", "c"): PairGeometry(num_inliers=100, rotation=np.eye(3)),
        ("c", "d"): PairGeometry(num_inliers=100, rotation=np.eye(3), spread=0.25),
    }
    got = edge_weights(pairs)
    half = TRUST.weak * np.median([400, 400, 100, 50])
    for pair, (weight, best) in zip(
        pairs, ((400, 400), (100, 200), (50, 50 * 2**0.5)), strict=True
    ):
        assert got[pair] == pytest.approx(weight / best / (1 + (half / weight) ** TRUST.steepness))
    assert edge_weights({}) == {}
    nothing = PairGeometry(num_inliers=0, rotation=None)
    more = edge_weights({**pairs, ("e", "f"): nothing, ("g", "h"): nothing, ("i", "j"): nothing})
    assert more == {**got, ("e", "f"): 0.0, ("g", "h"): 0.0, ("i", "j"): 0.0}


def test_the_best_pair_of_an_image_is_weak_if_all_of_its_pairs_are():
    """An image whose pairs are all false has a best pair, too."""
    _, _, pairs = ring(rng_of(0))
    alone = ("0.jpg", "night.jpg")
    for inliers, strong in ((250, False), (1500, True)):
        got = edge_weights(pairs | {alone: PairGeometry(num_inliers=inliers, rotation=np.eye(3))})
        assert (got[alone] > TRUST.strong) == strong


def test_spread_counts_covered_cells():
    corner = np.asarray([[-0.5, -0.5], [0.0, 0.0]])
    assert spread(corner, (80, 80)) == 1 / 64
    grid = np.stack(np.meshgrid(np.arange(80.0), np.arange(80.0)), -1).reshape(-1, 2)
    assert spread(grid, (80, 80)) == 1.0
    assert spread(np.asarray([[79.5, 79.5]]), (80, 80)) == 1 / 64  # on the very edge


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_angles_and_means_of_rotations_are_scipys(seed):
    rng = rng_of(seed)
    some = Rotation.from_rotvec(rng.normal(0, 0.4, (5, 3)))
    weights = rng.uniform(0.1, 1, 5)
    want = some.mean(weights).as_matrix()
    np.testing.assert_allclose(mean_rotation(some.as_matrix(), weights), want, atol=1e-6)
    got = rotation_angle_deg(some[0].as_matrix(), some[1].as_matrix())
    assert got == pytest.approx(np.degrees((some[0].inv() * some[1]).magnitude()), abs=1e-5)
