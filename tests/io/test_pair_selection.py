"""The option `--pairs` selects the pairs that it names."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsfm.errors import UserError
from jaxsfm.io.pair_selection import (
    FEW,
    MANY,
    PairSelection,
    chosen_pairs,
    natural,
    parse_pair_selection,
    selected_pairs,
    sequential_pairs,
)
from jaxsfm.io.pairs import exhaustive_pairs

NAMES = ["img1.png", "img2.png", "img10.png", "img11.png"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pairs.txt").write_text("img1.png img11.png\n")
    return tmp_path


@pytest.mark.parametrize(
    ("text", "selection"),
    [
        ("exhaustive", PairSelection(exhaustive=True)),
        ("pairs.txt", PairSelection(files=(Path("pairs.txt"),))),
        ("retrieval:20", PairSelection(retrieval=20)),
        ("sequential:3", PairSelection(sequential=3)),
        ("sequential:3+retrieval:20", PairSelection(sequential=3, retrieval=20)),
        ("retrieval:5+retrieval:20+retrieval:7", PairSelection(retrieval=20)),
        ("pairs.txt+sequential:1", PairSelection(files=(Path("pairs.txt"),), sequential=1)),
    ],
)
def test_a_selection_is_the_union_of_its_parts(text, selection):
    assert parse_pair_selection(text) == selection


@pytest.mark.parametrize("name", ["exhaustive", "retrieval:2", "a+b", "sequential:2+exhaustive"])
def test_a_file_of_that_very_name_comes_first(folder, name):
    (folder / name).write_text("img1.png img2.png\n")
    assert parse_pair_selection(name) == PairSelection(files=(Path(name),))


@pytest.mark.parametrize(
    "text",
    [
        "retrieval:0",
        "retrieval:",
        "retrieval:-1",
        "retrieval:x",
        "sequential:1.5",
        "sequential:9e9",
    ],
)
def test_a_number_that_is_none_is_refused(text):
    with pytest.raises(UserError, match=f"--pairs {text}: a whole number of at least 1"):
        parse_pair_selection(f"exhaustive+{text}")


@pytest.mark.parametrize(
    "text", ["", "nowhere.txt", "retrieval", "exhaustive+", "a\0b", 9999 * "x"]
)
def test_what_is_no_part_is_refused(text):
    with pytest.raises(UserError, match="is neither a file nor exhaustive, sequential:K or"):
        parse_pair_selection(text)


def test_pairs_of_several_parts_are_united_once():
    pairs = selected_pairs(
        parse_pair_selection("pairs.txt+sequential:1+sequential:2"), NAMES, NAMES
    )
    assert pairs == sorted({("img1.png", "img11.png"), *sequential_pairs(NAMES, 2)})
    everything = selected_pairs(parse_pair_selection("exhaustive+pairs.txt"), NAMES, NAMES)
    assert everything == exhaustive_pairs(NAMES)
    assert selected_pairs(parse_pair_selection("retrieval:2"), NAMES, NAMES) == []


def test_a_sequence_follows_the_numbers_in_names():
    assert sorted(reversed(NAMES), key=natural) == NAMES
    assert sequential_pairs(NAMES, 1) == [
        ("img1.png", "img2.png"),
        ("img10.png", "img11.png"),
        ("img10.png", "img2.png"),
    ]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text(max_size=9), unique=True, max_size=7), st.integers(1, 8), st.randoms())
def test_a_sequence_does_not_depend_on_order_and_is_whole(names, k, random):
    pairs = sequential_pairs(names, k)
    assert len(pairs) == sum(min(k, len(names) - 1 - i) for i in range(len(names)))
    random.shuffle(names)
    assert sequential_pairs(names, k) == pairs
    if k >= len(names) - 1:
        assert pairs == exhaustive_pairs(names)


@given(st.lists(st.text("0123456789ab²٣", max_size=6), max_size=5))
def test_any_names_can_be_ordered(names):
    assert sorted(names, key=natural) == sorted(reversed(names), key=natural)


def test_auto_tries_all_pairs_of_few_photos_and_similar_ones_and_neighbours_of_many(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert (chosen_pairs("auto", FEW), chosen_pairs("auto", FEW + 1)) == ("exhaustive", MANY)
    many = parse_pair_selection(MANY)
    assert many.retrieval >= 10 and many.sequential >= 1 and not many.exhaustive
    for text in ("exhaustive", "retrieval:2", "pairs.txt"):
        assert chosen_pairs(text, 10_000) == text
    (tmp_path / "auto").write_text("a b")
    assert chosen_pairs("auto", 10_000) == "auto"
