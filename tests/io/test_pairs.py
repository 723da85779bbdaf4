"""Files of pairs are read or refused by line; the best pairs are those of the definition."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsfm.errors import UserError
from jaxsfm.io.pairs import (
    best_pairs,
    component_of,
    components,
    exhaustive_pairs,
    make_pair,
    read_pairs,
)

NAMES = ["a.jpg", "b.jpg", "c d.jpg", "c", "d.jpg", "é/ü.jpg"]


@given(st.lists(st.text(min_size=1), unique=True, max_size=8))
def test_exhaustive_is_every_pair_once_in_order(names):
    pairs = exhaustive_pairs(names)
    assert len(pairs) == len(set(pairs)) == math.comb(len(names), 2)
    assert pairs == sorted(pairs) and all(a < b for a, b in pairs)
    assert pairs == exhaustive_pairs(reversed(names))


@given(st.text(), st.text())
def test_a_pair_has_one_order(a, b):
    assert make_pair(a, b) == make_pair(b, a) == tuple(sorted((a, b)))


# -- pair files -----------------------------------------------------------------------------------


def read(tmp_path, text: str):
    path = tmp_path / "pairs.txt"
    path.write_text(text, encoding="utf-8")
    return read_pairs(path, NAMES)


@pytest.mark.parametrize(
    "line",
    [
        "a.jpg b.jpg",
        "b.jpg a.jpg",
        "  a.jpg    b.jpg  ",
        "a.jpg\tb.jpg",
        "a.jpg \t b.jpg",
        "# comment\n\n   # indented\na.jpg b.jpg\n",
        "a.jpg b.jpg\nb.jpg a.jpg\na.jpg b.jpg",
        "a.jpg b.jpg\r\n",
    ],
)
def test_blanks_tabs_comments_order_and_repeats_do_not_matter(tmp_path, line):
    assert read(tmp_path, line) == [("a.jpg", "b.jpg")]


@pytest.mark.parametrize("blank", [" ", "\t"])
@pytest.mark.parametrize(
    "pair", [("a.jpg", "c d.jpg"), ("c d.jpg", "d.jpg"), ("c d.jpg", "é/ü.jpg")]
)
def test_names_may_hold_blanks(tmp_path, pair, blank):
    assert read(tmp_path, blank.join(pair)) == [pair]
    assert read(tmp_path, blank.join(reversed(pair))) == [pair]


def test_pairs_come_out_sorted(tmp_path):
    text = "d.jpg b.jpg\nc a.jpg\nb.jpg a.jpg"
    assert read(tmp_path, text) == [("a.jpg", "b.jpg"), ("a.jpg", "c"), ("b.jpg", "d.jpg")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.jpg b.jpg\n\na.jpg x.jpg", "line 3: no image named 'x.jpg'"),
        ("x.jpg\ta.jpg", "line 1: no image named 'x.jpg'"),
        ("# c\na.jpg a.jpg", "line 2: 'a.jpg' is paired with itself"),
        ("a.jpg", "line 1: expected two image names"),
        ("a.jpg b.jpg 0.5", "line 1: expected two image names"),
        ("a.jpg\t", "line 1: expected two image names"),
        ("", "lists no pairs"),
        ("# nothing\n\n", "lists no pairs"),
    ],
)
def test_a_bad_file_is_refused_with_its_line(tmp_path, text, message):
    with pytest.raises(UserError, match=message) as error:
        read(tmp_path, text)
    assert "pairs.txt" in str(error.value)


def test_a_missing_or_binary_file_is_refused(tmp_path):
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x80")
    for name in ("none.txt", "binary.txt"):
        with pytest.raises(UserError, match=f"{name}: cannot be read as text"):
            read_pairs(tmp_path / name, NAMES)


# -- best pairs -----------------------------------------------------------------------------------

IMAGES = "abcdefg"
graphs = st.dictionaries(st.sampled_from(exhaustive_pairs(IMAGES)), st.integers(0, 6), max_size=21)
law = settings(max_examples=60, deadline=None)


@law
@given(graphs, st.integers(1, 4), st.randoms(use_true_random=False))
def test_best_pairs_do_not_depend_on_order(counts, n, random):
    rows = list(counts.items())
    random.shuffle(rows)
    assert best_pairs(dict(rows), n) == best_pairs(counts, n)


@law
@given(graphs, st.integers(1, 4), st.permutations(IMAGES))
def test_without_ties_best_pairs_do_not_depend_on_names(counts, n, names):
    distinct = {pair: 100 * c + i for i, (pair, c) in enumerate(counts.items()) if c}
    rename = dict(zip(IMAGES, names, strict=True))
    renamed = {make_pair(rename[a], rename[b]): c for (a, b), c in distinct.items()}
    expected = {make_pair(rename[a], rename[b]) for a, b in best_pairs(distinct, n)}
    assert best_pairs(renamed, n) == expected


@law
@given(graphs, st.integers(1, 4))
def test_a_pair_stays_iff_fewer_than_n_beat_it_on_one_side(counts, n):
    """The definition, computed slowly; equal counts are decided by the other image's name."""

    def better(pair, image):
        other = next(name for name in pair if name != image)
        rivals = [(p, next(x for x in p if x != image)) for p in counts if image in p]
        key = (-counts[pair], other)
        return sum((-counts[p], x) < key for p, x in rivals)

    expected = {p for p, c in counts.items() if c > 0 and min(better(p, image) for image in p) < n}
    assert best_pairs(counts, n) == expected


@law
@given(graphs, st.integers(1, 4))
def test_every_image_keeps_its_best_pair(counts, n):
    kept = best_pairs(counts, n)
    for image in IMAGES:
        own = {pair: c for pair, c in counts.items() if image in pair and c > 0}
        if own:
            assert any(counts[p] == max(own.values()) for p in kept if image in p)


@law
@given(graphs, st.integers(1, 6))
def test_more_best_pairs_only_add(counts, n):
    assert best_pairs(counts, n) <= best_pairs(counts, n + 1)


@law
@given(graphs)
def test_many_best_pairs_are_all_with_inliers(counts):
    assert best_pairs(counts, len(IMAGES)) == {pair for pair, c in counts.items() if c > 0}


@pytest.mark.parametrize("n", [0, -1])
def test_fewer_than_one_best_pair_is_refused(n):
    with pytest.raises(ValueError, match="at least 1"):
        best_pairs({}, n)


@given(st.sets(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=14))
def test_the_groups_that_edges_join_are_the_components_of_their_images_the_largest_first(rows):
    names, edges = (
        [f"{k}" for k in range(9)],
        [make_pair(f"{a}", f"{b}") for a, b in rows if a != b],
    )
    found = components(names, edges)
    assert sorted(name for group in found for name in group) == names
    assert all(group == component_of({name}, edges) for group in found for name in group)
    assert found == sorted(found, key=lambda group: (-len(group), min(group)))
