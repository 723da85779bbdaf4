"""Which photos are numbered one after the other, and which pairs follow from that."""

import itertools

import numpy as np
import pytest

from jaxsfm.io.pairs import component_of, make_pair
from jaxsfm.sfm.photo_order import follow, neighbours, ordered, orders


def numbered(numbers, pattern="IMG_{:04d}.jpg"):
    return [pattern.format(k) for k in numbers]


def test_photos_are_ordered_by_their_numbers_not_by_their_letters():
    assert orders(numbered([10, 9, 11, 8, 12], "a{}.jpg")) == [numbered(range(8, 13), "a{}.jpg")]


def test_each_folder_and_each_pattern_has_an_order_of_its_own():
    one, two = (numbered(range(6), f"{folder}/2024_{{:03d}}.png") for folder in "ab")
    three = numbered(range(6), "DSC{}.JPG")
    assert sorted(orders([*three, *two, *one])) == sorted([one, two, three])


def test_some_numbers_may_be_missing_and_frames_may_be_ten_apart():
    frames = numbered([0, 10, 20, 50, 60, 70, 100, 110])
    assert orders(frames[::-1]) == [frames]


@pytest.mark.parametrize("seed", range(5))
def test_identifiers_have_no_order(seed):
    numbers = np.random.default_rng(seed).choice(10**9, 40, replace=False)
    assert orders(numbered(numbers, "{}_large.jpg")) == []


def test_names_without_numbers_and_four_photos_have_no_order():
    assert orders(["dome.jpg", "gate.jpg", *numbered(range(4))]) == []
    assert orders(numbered(range(5))) == [numbered(range(5))]


@pytest.mark.parametrize("seed", range(5))
def test_links_are_a_tree_of_the_smallest_steps(seed):
    """The oracle: for each link, no pair with a smaller step joins the same two parts."""
    rng = np.random.default_rng(seed)
    names = numbered(range(12))
    every = list(itertools.combinations(names, 2))
    pairs = {every[k]: float(rng.random()) for k in rng.choice(len(every), 40, replace=False)}
    taken = follow([names], pairs)
    joined = {name for pair in pairs for name in pair}
    parts = {frozenset(component_of([name], pairs)) for name in joined}
    assert len(taken) == len(joined) - len(parts)

    def cost(pair):
        return names.index(pair[1]) - names.index(pair[0]), -pairs[pair]

    for link in taken:
        side = component_of([link[0]], taken - {link})
        across = [pair for pair in pairs if (pair[0] in side) != (pair[1] in side)]
        assert min(across, key=cost) == link


def test_photos_outside_the_order_are_joined_last_by_their_strongest_pairs():
    names = numbered(range(5))
    pairs = {pair: 0.1 for pair in itertools.pairwise(names)}
    pairs |= {make_pair(names[0], "guest.jpg"): 0.7, make_pair(names[4], "guest.jpg"): 0.9}
    assert follow([names], pairs) == {
        *itertools.pairwise(names),
        make_pair(names[4], "guest.jpg"),
    }


def test_neighbours_are_those_of_the_pairs_whose_photos_follow_each_other():
    names = [f"b{n}" for n in (2, 10, 18, 26, 34)]
    ring = [make_pair(a, b) for a, b in itertools.combinations([*names, "guest"], 2)]
    inside = {("b10", "b2"), ("b10", "b18"), ("b18", "b26"), ("b26", "b34")}
    assert neighbours(ring) == inside
    assert neighbours([pair for pair in ring if pair != ("b18", "b26")]) == inside - {
        ("b18", "b26")
    }
    assert neighbours([]) == set()


@pytest.mark.parametrize(("numbered_ones", "others", "enough"), [(6, 6, True), (6, 7, False)])
def test_an_order_of_few_photos_does_not_say_how_to_join_all(numbered_ones, others, enough):
    names = numbered(range(numbered_ones))
    found = [names[:4], names[2:]]  # photos in two orders count once
    assert ordered(found, [*names, *(f"guest{k}" for k in range(others))]) == enough
