"""Matches of detector-free matchers: points that differ in every pair become common keypoints."""

import h5py
import numpy as np
import pytest
from foreign_model import NAMES, SIZE, camera, exact_model, image_files
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import mutated
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxsfm.colmap.external_matches import read_external_matches
from jaxsfm.colmap.formats.dense_matches import PairPoints, gather, gather_pairs, read_dense_matches
from jaxsfm.errors import UserError
from jaxsfm.io.pairs import exhaustive_pairs

SIZES = dict.fromkeys(NAMES, SIZE)
POINTS = 60


@pytest.fixture(scope="module")
def truth() -> dict[str, dict[int, np.ndarray]]:
    """By photo, where it shows the points."""
    model = exact_model([camera("PINHOLE")], points=POINTS)
    return {
        image.name: {p.point3D_id: p.xy - 0.5 for p in image.points2D if p.has_point3D()}
        for image in model.images.values()
    }


def write(path, truth, *, sigma=0.4, older=False, scores=True, flip=False):
    """The points of every pair, each time with other errors and in another order."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for a, b in exhaustive_pairs(truth):
            if flip:
                a, b = b, a
            both = rng.permutation(sorted(truth[a].keys() & truth[b].keys()))
            short = [name.replace("/", "-") for name in (a, b)]
            group = file.create_group("_".join(short) if older else "/".join(short))
            for key, name in (("keypoints0", a), ("keypoints1", b)):
                xy = np.asarray([truth[name][k] for k in both])
                group[key] = np.float32(xy + rng.normal(0, sigma, xy.shape))
            if scores:
                group["scores"] = rng.uniform(0.2, 1, len(both)).astype(np.float16)
    return path


def tracks_of(tables) -> list[set[tuple[str, int]]]:
    """The sets of keypoints that matches join."""
    node = {}
    for pair, rows in tables.matches.items():
        for row in rows.tolist():
            for key in zip(pair, row, strict=True):
                node.setdefault(key, len(node))
    edges = np.asarray(
        [
            [node[key] for key in zip(pair, row, strict=True)]
            for pair, rows in tables.matches.items()
            for row in rows.tolist()
        ]
    )
    graph = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(len(node), len(node)))
    _, label = connected_components(graph, directed=False)
    sets: dict[int, set] = {}
    for key, k in node.items():
        sets.setdefault(int(label[k]), set()).add(key)
    return list(sets.values())


@pytest.mark.parametrize("older", [False, True])
def test_tracks_reach_all_photos_that_show_a_point(tmp_path, truth, older):
    """Without common keypoints they would have two observations each."""
    tables = read_dense_matches(
        write(tmp_path / "m.h5", truth, older=older), SIZES, where="--with-dense m.h5"
    )
    shown = {k: sum(k in each for each in truth.values()) for k in range(1, POINTS + 1)}
    tracks = tracks_of(tables)
    assert abs(len(tracks) - POINTS) <= 3
    assert np.mean([len(track) for track in tracks]) > 0.93 * np.mean(list(shown.values())) > 3.5
    for name, xy in tables.keypoints.items():
        exact = np.asarray(list(truth[name].values()))
        off = np.linalg.norm(xy[:, None] - exact, axis=2).min(1)
        assert off.max() < 1.5 and np.median(off) < 0.4  # a mean is better than one position
    for rows in tables.matches.values():
        assert all(len(np.unique(column)) == len(column) for column in rows.T)


def test_the_order_of_photos_in_a_pair_and_missing_scores_change_little(tmp_path, truth):
    one = read_dense_matches(write(tmp_path / "a.h5", truth, sigma=0), SIZES, where="a")
    other = read_dense_matches(
        write(tmp_path / "b.h5", truth, sigma=0, flip=True, scores=False), SIZES, where="b"
    )
    assert one.matches.keys() == other.matches.keys()
    for (a, b), rows in one.matches.items():
        sets = [
            {
                (*t.keypoints[a][i].round(2).tolist(), *t.keypoints[b][j].round(2).tolist())
                for i, j in r.tolist()
            }
            for t, r in ((one, rows), (other, other.matches[a, b]))
        ]
        assert sets[0] == sets[1]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.floats(1, 50))
def test_gathering_does_not_depend_on_the_order_of_points(seed, count, spread):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, spread, (count, 2)).round(1).astype(np.float32)
    weight = rng.choice([0.25, 0.5, 1.0], count)
    order = rng.permutation(count)
    keypoints, label = gather(xy, weight, 4.0)
    again, moved = gather(xy[order], weight[order], 4.0)
    np.testing.assert_array_equal(again, keypoints)
    np.testing.assert_array_equal(moved, label[order])
    # A keypoint is the weighted mean of its own points, which lie around it.
    for k, at in enumerate(keypoints):
        own = label == k
        assert own.any()
        np.testing.assert_allclose(at, np.average(xy[own], axis=0, weights=weight[own]), atol=1e-4)
        assert np.abs(xy[own] - at).max() < 2 * 4.0


def test_points_at_the_border_of_cells_stay_together():
    """Four cells meet at (4, 4); the points around it are one keypoint."""
    xy = np.asarray([[3.9, 3.9], [4.1, 3.9], [3.9, 4.1], [4.1, 4.1], [4.2, 4.2]], np.float32)
    keypoints, label = gather(xy, np.ones(5), 4.0)
    assert len(keypoints) == 1 and not label.any()
    far = np.asarray([[2.0, 2.0], [6.0, 2.0]], np.float32)
    assert len(gather(far, np.ones(2), 4.0)[0]) == 2


def test_the_surest_of_several_matches_of_a_keypoint_counts():
    xy0 = np.asarray([[2, 2], [2, 2], [22, 2]], np.float32)
    xy1 = np.asarray([[2, 2], [22, 2], [22, 2]], np.float32)
    each = PairPoints(("a", "b"), xy0, xy1, np.asarray([0.5, 0.9, 0.3]))
    keypoints, matches = gather_pairs([each], {"a": 4.0, "b": 4.0})
    (rows,) = matches.values()
    found = {(float(keypoints["a"][i, 0]), float(keypoints["b"][j, 0])) for i, j in rows}
    assert found == {(2.0, 22.0)}


def test_the_matches_are_mapped_like_those_of_other_files(tmp_path, truth):
    path = write(tmp_path / "m.h5", truth)
    given = read_external_matches(None, None, image_files(NAMES, tmp_path), None, dense=path)
    assert given.about is not None and given.about["pairs"] == len(given.matches) == 6
    result = given.result(min(given.matches))
    assert result.num_inliers == len(given.matches[min(given.matches)]) > 40
    with pytest.raises(UserError, match="give only one of them"):
        read_external_matches(tmp_path, None, image_files(NAMES, tmp_path), None, dense=path)


def test_what_cannot_be_used_is_refused_in_one_sentence(tmp_path, truth):
    path = tmp_path / "m.h5"

    def refused(match, sizes=SIZES):
        with pytest.raises(UserError, match=match) as info:
            read_dense_matches(path, sizes, where="--with-dense m.h5")
        assert str(info.value).startswith("--with-dense m.h5: ")

    refused("no such file")
    path.write_text("no HDF5")
    refused("not a readable file of matches")
    write(path, truth)
    refused("no pair of the photos", {"other.jpg": SIZE})
    refused("cannot tell", {**SIZES, "sub-b.jpg": SIZE})
    with h5py.File(path, "a") as file:
        group = file["a.jpg"]["sub-b.jpg"]
        file.copy(group, "sub-b.jpg/a.jpg")
    refused("is given twice")
    write(path, truth)
    with h5py.File(path, "a") as file:
        group = file["a.jpg"]["sub-b.jpg"]
        short = group["keypoints1"][:-1]
        del group["keypoints1"]
        group["keypoints1"] = short
    refused("must be of the same matches")
    with h5py.File(path, "a") as file:
        group = file["a.jpg"]["sub-b.jpg"]
        del group["keypoints1"]
        group["keypoints1"] = np.full(group["keypoints0"].shape, np.nan)
    refused("must be finite")


def test_a_damaged_file_gives_a_result_or_one_sentence(tmp_path, truth):
    rng = np.random.default_rng(0)
    whole = write(tmp_path / "m.h5", truth).read_bytes()
    refused = 0
    for _ in range(60):
        (tmp_path / "bad.h5").write_bytes(mutated(whole, rng))
        try:
            read_dense_matches(tmp_path / "bad.h5", SIZES, where="--with-dense")
        except UserError as error:
            assert str(error).startswith("--with-dense")
            refused += 1
    assert refused > 5
