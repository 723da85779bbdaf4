"""Laws of mapping in parts: how photos are divided, how models are put into one frame, and what the
joined model holds. The mapper is left out where it can be."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mapped import verified
from room_scene import noisy_model
from scipy.spatial.transform import Rotation

from jaxsfm.bench.simulated import SimulatedStreet
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Mapped
from jaxsfm.colmap.model import Model, stored_sizes
from jaxsfm.colmap.model_images import registered
from jaxsfm.colmap.poses import CameraPose, model_poses
from jaxsfm.sfm import mapper_runs
from jaxsfm.sfm.evaluation import Similarity, umeyama
from jaxsfm.sfm.parts import map_parts as module
from jaxsfm.sfm.parts.frames import (
    IDENTITY,
    SharedPoints,
    after,
    common_frames,
    inverse,
    shared_points,
)
from jaxsfm.sfm.parts.merge import merged
from jaxsfm.sfm.parts.partition import MOST_ADDED, SLACK, graph_of, overlapping_parts


def chain(count: int, reach: int = 3) -> dict[tuple[str, str], int]:
    """Photos in a row, each matched with the next ones; near ones have more matches."""
    names = [f"{k:03d}" for k in range(count)]
    return {
        (names[i], names[j]): 100 * (reach + 1 - (j - i))
        for i in range(count)
        for j in range(i + 1, min(count, i + reach + 1))
    }


def blobs(sizes: list[int]) -> dict[tuple[str, str], int]:
    """Groups in which all photos are matched well, and weak pairs from each group to the next."""
    groups = [
        [f"{g}{k:02d}" for k in range(size)] for g, size in zip("abcdef", sizes, strict=False)
    ]
    pairs = {pair: 200 for group in groups for pair in itertools.combinations(group, 2)}
    for one, other in itertools.pairwise(groups):
        pairs |= {(one[-1], other[0]): 20, (one[-2], other[1]): 20}
    return pairs


@given(st.integers(2, 90), st.integers(2, 30), st.integers(0, 8), st.randoms())
@settings(max_examples=40, deadline=None)
def test_parts_cover_all_photos_are_small_and_do_not_depend_on_the_order_of_pairs(
    count, size, overlap, shuffle
):
    pairs = chain(count)
    parts = overlapping_parts(graph_of(pairs), size=size, overlap=overlap)
    assert {name for part in parts for name in part} == {name for pair in pairs for name in pair}
    largest = (1 + 2 * SLACK) * size
    assert all(len(part) <= largest + max(overlap, MOST_ADDED * largest) for part in parts)
    assert all(part == sorted(set(part)) for part in parts) and parts == sorted(parts)
    mixed = list(pairs.items())
    shuffle.shuffle(mixed)
    assert overlapping_parts(graph_of(dict(mixed)), size=size, overlap=overlap) == parts


def test_parts_of_a_row_are_stretches_that_share_photos_with_the_next_ones():
    parts = overlapping_parts(graph_of(chain(200)), size=60, overlap=10)
    # 3.3 times the size: about 67 photos each, and those that they share.
    assert len(parts) == 3 and all(50 <= len(part) <= 110 for part in parts)
    for part in parts:
        numbers = [int(name) for name in part]
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
    for one, other in itertools.pairwise(parts):
        assert len(set(one) & set(other)) == 10


def test_a_cut_goes_where_pairs_are_weakest():
    (a, b) = overlapping_parts(graph_of(blobs([14, 22])), size=20, overlap=0)
    assert {name[0] for name in a} == {"a"} and {name[0] for name in b} == {"b"}


def test_photos_without_a_common_pair_are_in_different_parts():
    pairs = {**chain(10), **{("x" + a, "x" + b): n for (a, b), n in chain(7).items()}}
    parts = overlapping_parts(graph_of(pairs), size=50, overlap=4)
    assert [len(part) for part in parts] == [10, 7]


def test_a_pair_without_matches_is_no_pair():
    graph = graph_of({("a", "b"): 5, ("b", "c"): 0})
    assert graph.names == ["a", "b"]
    assert overlapping_parts(graph_of({}), size=5, overlap=1) == []


@pytest.mark.parametrize(("size", "overlap"), [(1, 3), (5, -1)])
def test_parts_that_are_too_small_are_refused(size, overlap):
    with pytest.raises(ValueError, match=f"got {size} and {overlap}"):
        overlapping_parts(graph_of(chain(5)), size=size, overlap=overlap)


def similarity(rng: np.random.Generator, *, size: float = 1.0) -> Similarity:
    """A random similarity; with a small `size`, one near the identity."""
    turn = Rotation.from_rotvec(size * rng.normal(0, 1, 3)).as_matrix()
    return Similarity(float(np.exp(size * rng.normal(0, 0.5))), turn, size * rng.normal(0, 3, 3))


def test_a_similarity_and_its_inverse_leave_everything_where_it_is():
    rng = np.random.default_rng(0)
    one, points = similarity(rng), rng.normal(0, 1, (5, 3))
    np.testing.assert_allclose(inverse(one).moved_points(one.moved_points(points)), points)
    both = after(one, similarity(np.random.default_rng(1)))
    inner = similarity(np.random.default_rng(1))
    np.testing.assert_allclose(
        both.moved_points(points), one.moved_points(inner.moved_points(points))
    )


def ring(count: int, drift: float, *, seed: int = 0):
    """Models in a ring, in frames of their own. What they share says where the next one lies, each
    time turned a little too far."""
    rng = np.random.default_rng(seed)
    truth = [IDENTITY, *(similarity(rng) for _ in range(count - 1))]
    shared = {}
    for i in range(count):
        j = (i + 1) % count
        world = rng.normal(0, 1, (40, 3)) + 10 * np.asarray(
            [np.cos(2 * np.pi * i / count), np.sin(2 * np.pi * i / count), 0]
        )
        off = similarity(np.random.default_rng(9), size=drift)
        first = inverse(truth[i]).moved_points(world)
        second = inverse(truth[j]).moved_points(off.moved_points(world))
        relative = after(inverse(truth[i]), after(inverse(off), truth[j]))
        pair = (i, j) if i < j else (j, i)
        each = SharedPoints(first, second, relative)
        shared[pair] = each if i < j else each.turned()
    return truth, shared


def test_frames_that_fit_together_are_found_exactly():
    truth, shared = ring(6, 0.0)
    (found,) = common_frames(6, shared)
    for number, frame in found.items():
        np.testing.assert_allclose(frame.rotation, truth[number].rotation, atol=1e-6)
        np.testing.assert_allclose(frame.translation, truth[number].translation, atol=1e-5)
        assert frame.scale == pytest.approx(truth[number].scale, rel=1e-6)


def test_what_a_ring_does_not_close_by_is_spread_over_all_of_its_models():
    """Along a tree of models, all of it would be where the ring is cut."""
    _, shared = ring(6, 0.02)
    (found,) = common_frames(6, shared)

    def gaps(frames):
        return [
            np.linalg.norm(
                frames[i].moved_points(each.first) - frames[j].moved_points(each.second), axis=1
            ).mean()
            for (i, j), each in shared.items()
        ]

    tree = {0: IDENTITY}
    for k in range(5):
        tree[k + 1] = after(tree[k], shared[k, k + 1].similarity)
    assert max(gaps(found)) < 0.4 * max(gaps(tree))


def test_models_that_share_nothing_have_frames_of_their_own():
    _, shared = ring(6, 0.0)
    left = {pair: each for pair, each in shared.items() if pair in {(0, 1), (3, 4)}}
    groups = common_frames(6, left)
    assert [sorted(group) for group in groups] == [[0, 1], [2], [3, 4], [5]]
    assert groups[2][3] == IDENTITY


def parts_of(model: Model, groups: list[list[int]], frames: list[Similarity]) -> list[Model]:
    """Parts of a model, each in a frame of its own."""
    found = []
    for group, frame in zip(groups, frames, strict=True):
        part, _ = model.part([model.views[k].name for k in group])
        views = []
        for view in part.views:
            pose = frame.moved(CameraPose(view.rotation, view.centre))
            views.append(dataclasses.replace(view, rotation=pose.rotation, centre=pose.centre))
        tracks = part.tracks._replace(points=frame.moved_points(part.tracks.points))
        found.append(dataclasses.replace(part, views=views, tracks=tracks))
    return found


def numbered(models: list[Model]) -> dict[int, Similarity]:
    """The frames of models in that of the first one."""
    shared = shared_points(models, error_px=1.0)
    (found,) = common_frames(len(models), shared)
    return found


@pytest.fixture
def whole(rendered):
    """An exact model of five photos of a room."""
    model = noisy_model(rendered, 0.0)
    return Model.from_colmap(model, stored_sizes(model))


def test_models_of_one_room_make_the_whole_again(whole):
    frames = [IDENTITY, similarity(np.random.default_rng(3)), similarity(np.random.default_rng(4))]
    parts = parts_of(whole, [[0, 1, 2, 3], [1, 2, 3, 4], [0, 2, 3, 4]], frames)
    found = merged(parts, numbered(parts))
    assert [view.name for view in found.views] == [view.name for view in whole.views]
    for view, own in zip(found.views, whole.views, strict=True):
        np.testing.assert_allclose(view.centre, own.centre, atol=1e-6)
        np.testing.assert_allclose(view.rotation, own.rotation, atol=1e-6)
    # Each keypoint belongs to one point, as before, and lies where it did.
    assert len(found.tracks.point) == len(whole.tracks.point)
    assert len(found.tracks.points) == len(whole.tracks.points)
    assert found.errors_px().max() < 1e-3


def test_models_that_share_two_photos_are_not_put_together(whole):
    frames = [IDENTITY, similarity(np.random.default_rng(3))]
    parts = parts_of(whole, [[0, 1, 2], [1, 2, 3, 4]], frames)
    assert shared_points(parts, error_px=1.0) == {}


def test_models_that_do_not_agree_are_not_put_together(whole):
    parts = parts_of(whole, [[0, 1, 2, 3], [1, 2, 3, 4]], [IDENTITY, IDENTITY])
    points = np.random.default_rng(0).permutation(parts[1].tracks.points)
    parts[1] = parts[1].with_tracks(parts[1].tracks._replace(points=points))
    assert shared_points(parts, error_px=1.0) == {}


def test_points_stay_apart_if_one_point_would_have_two_keypoints_in_a_photo(whole):
    """The second model took two points for one."""
    one, other = parts_of(whole, [[0, 1, 2, 3], [1, 2, 3, 4]], [IDENTITY, IDENTITY])
    tracks = one.tracks
    in_both = np.flatnonzero(np.isin(tracks.point, tracks.point[one.rows[0]]))
    a, b = np.unique(tracks.point[in_both])[:2]
    keypoint = {k: tracks.xy[(tracks.point == k) & (tracks.view == 1)] for k in (a, b)}
    where = {
        k: np.flatnonzero((other.tracks.xy == xy).all(1) & (other.tracks.view == 0))
        for k, xy in keypoint.items()
        if len(xy)
    }
    assert len(where) == 2
    (row_a,), (row_b,) = where.values()
    point = other.tracks.point.copy()
    point[point == point[row_b]] = point[row_a]
    wrong = other.with_tracks(other.tracks._replace(point=point))
    found = merged([one, wrong], {0: IDENTITY, 1: IDENTITY})
    pairs = np.c_[found.tracks.point, found.tracks.view]
    per_photo = [len(np.unique(found.tracks.point[rows])) for rows in found.rows]
    assert sum(per_photo) == len(np.unique(pairs, axis=0))
    own = [
        found.tracks.point[(found.tracks.xy == keypoint[k][0]).all(1) & (found.tracks.view == 1)]
        for k in (a, b)
    ]
    assert own[0] != own[1]


def test_a_photo_has_the_pose_of_the_model_in_which_it_sees_most(whole):
    one, other = parts_of(whole, [[0, 1, 2, 3], [1, 2, 3, 4]], [IDENTITY, IDENTITY])
    few = one.select(np.r_[one.rows[0], one.rows[1], one.rows[2], one.rows[3][:5]])
    views = [dataclasses.replace(view, centre=view.centre + 1.0) for view in few.views]
    found = merged([few.with_views(views), other], {0: IDENTITY, 1: IDENTITY})
    moved = [
        not np.allclose(view.centre, own.centre)
        for view, own in zip(found.views, whole.views, strict=True)
    ]
    assert moved[0] and not moved[3] and not moved[4]


def simulated_database(path, photos: int) -> dict[tuple[str, str], int]:
    """A verified database of a simulated street; returns the numbers of matches of its pairs."""
    street = SimulatedStreet(photos)
    known = street.intrinsics()
    matches = {pair: street.matches(pair) for pair in street.pairs()}
    write_database(path, street.images(), matches, Cameras(known=parse_intrinsics(known)))
    return {p: v.geometry.num_inliers for p, v in verified(path, OPTIONS).items()}


OPTIONS = MapOptions(refine_intrinsics=False, draft=True, threads=1)


@pytest.fixture(scope="module")
def row(tmp_path_factory):
    """A street of 40 photos: the path of its database, and the matches of its pairs."""
    path = tmp_path_factory.mktemp("row") / "d.db"
    return path, simulated_database(path, 40)


def worst_share(model, photos: int) -> float:
    """The largest error of a camera of a simulated street, as a share of its length."""
    poses, truth = model_poses(model), SimulatedStreet(photos)
    names = sorted(poses)
    ours = np.asarray([poses[name].centre for name in names])
    own = np.asarray([truth.poses[int(name[5:11])].centre for name in names])
    errors = np.linalg.norm(umeyama(ours, own).moved_points(ours) - own, axis=1)
    return float(errors.max() / np.ptp(own[:, 0]))


def test_a_street_that_is_mapped_in_parts_is_one_right_model(row, monkeypatch):
    monkeypatch.setattr(module, "PART", 14)
    monkeypatch.setattr(module, "OVERLAP", 8)
    database, matches = row
    steps = []
    made = module.map_in_parts(database, matches, OPTIONS, on_image=lambda: steps.append(1))
    assert made is not None and len(made.attempts) >= 3
    assert registered(made.models[0]) == {name for pair in matches for name in pair}
    assert len(steps) >= 40 and worst_share(made.models[0], 40) < 0.01
    again = module.map_in_parts(database, matches, OPTIONS)
    assert (
        again is not None
        and model_poses(again.models[0]).keys() == model_poses(made.models[0]).keys()
    )
    for name, pose in model_poses(made.models[0]).items():
        assert (pose.centre == model_poses(again.models[0])[name].centre).all()


def test_parts_that_make_no_one_model_do_not_count(row, monkeypatch):
    monkeypatch.setattr(module, "PART", 14)
    monkeypatch.setattr(module, "OVERLAP", 8)
    monkeypatch.setattr(module, "shared_points", lambda models, **_: {})
    database, matches = row
    assert module.map_in_parts(database, matches, OPTIONS) is None


@pytest.mark.parametrize(("many", "in_parts"), [(39, True), (40, False)])
def test_only_many_photos_are_mapped_in_parts(row, tmp_path, monkeypatch, many, in_parts):
    calls = []
    whole, part = Mapped([], []), Mapped([], [])
    monkeypatch.setattr(mapper_runs, "MANY", many)
    monkeypatch.setattr(mapper_runs, "map_in_parts", lambda *_, **__: calls.append(1) or part)
    monkeypatch.setattr(mapper_runs, "first_models", lambda *_, **__: whole)
    options = dataclasses.replace(OPTIONS, in_parts=True)
    made = mapper_runs.MapperRuns(row[0], tmp_path, options, share=False).first()
    assert (made is part) == in_parts and bool(calls) == in_parts


def test_the_incremental_mapper_alone_gets_all_photos(row, tmp_path, monkeypatch):
    monkeypatch.setattr(mapper_runs, "MANY", 3)
    monkeypatch.setattr(mapper_runs, "map_in_parts", lambda *_, **__: pytest.fail("in parts"))
    monkeypatch.setattr(mapper_runs, "first_models", lambda *_, **__: Mapped([], []))
    mapper_runs.MapperRuns(row[0], tmp_path, OPTIONS, share=False).first()


def test_all_photos_are_mapped_at_once_if_parts_do_not_agree(row, tmp_path, monkeypatch):
    whole = Mapped([], [])
    monkeypatch.setattr(mapper_runs, "MANY", 3)
    monkeypatch.setattr(mapper_runs, "map_in_parts", lambda *_, **__: None)
    monkeypatch.setattr(mapper_runs, "first_models", lambda *_, **__: whole)
    options = dataclasses.replace(OPTIONS, in_parts=True)
    assert mapper_runs.MapperRuns(row[0], tmp_path, options, share=False).first() is whole
