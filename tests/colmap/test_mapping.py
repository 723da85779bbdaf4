"""Second tries of the mapper, and scenes that make the first one hard."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
from mapped import map_database, verified
from room_scene import noisy_model
from scipy.spatial.transform import Rotation

from jaxsfm.colmap import mapper
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import drop_pairs, write_database
from jaxsfm.colmap.map_options import LEAST_PARALLAX, MapOptions, narrowest_angle_deg
from jaxsfm.colmap.mapper import attempt_of, build_models, complete, initial_pairs
from jaxsfm.colmap.reconstruction import registered, take_out
from jaxsfm.colmap.two_views import PairGeometry, TwoView, read_two_views
from jaxsfm.core.types import Status
from jaxsfm.io.pairs import PairResult, exhaustive_pairs
from jaxsfm.sfm.view_graph import rotation_angle_deg

ONE = MapOptions(refine_intrinsics=False, threads=1)


SAME = np.eye(3)


def two_view(inliers=100, angle=20.0, *, planar=False, rotation: np.ndarray | None = SAME):
    return TwoView(PairGeometry(num_inliers=inliers, rotation=rotation), angle, planar)


def test_initial_pairs_have_many_inliers_a_wide_angle_and_more_than_a_plane():
    views = {
        ("a", "b"): two_view(500, 2.0),
        ("a", "c"): two_view(300, 20.0),
        ("a", "d"): two_view(300, 60.0),
        ("b", "c"): two_view(900, 20.0, planar=True),
        ("b", "d"): two_view(900, 20.0, rotation=None),
        ("c", "d"): two_view(900, 0.0),
    }
    assert initial_pairs(views) == [("a", "c"), ("a", "d"), ("b", "c"), ("a", "b")]


class Model(SimpleNamespace):
    """As much of a reconstruction as choosing between models needs."""

    def num_reg_images(self):
        return len(self.names)

    def num_points3D(self):  # noqa: N802
        return self.points

    def reg_image_ids(self):
        return list(range(len(self.names)))

    def image(self, i):
        return SimpleNamespace(name=self.names[i])


def model(names: str, points=10) -> Model:
    return Model(names=list(names), points=points)


def runs(monkeypatch, outcomes):
    """`run_mapper` gives these outcomes in turn; the (mapper, pair) of every call are kept."""
    calls, left = [], list(outcomes)

    def run(database, options, *, start=None):
        calls.append((options.mapper, start))
        return left.pop(0)

    monkeypatch.setattr(mapper, "run_mapper", run)
    return calls


PAIRS = {pair: two_view(100 - k) for k, pair in enumerate(exhaustive_pairs("abcdef"))}


def test_a_complete_model_needs_one_attempt(monkeypatch, tmp_path):
    calls = runs(monkeypatch, [[model("abcdef")]])
    models = build_models(tmp_path / "d.db", PAIRS, ONE)
    assert calls == [("incremental", None)] and models[0].num_reg_images() == 6


def test_images_that_nothing_connects_are_no_reason_to_try_again(monkeypatch, tmp_path):
    calls = runs(monkeypatch, [[model("abc"), model("de")]])
    apart = {p: two_view() for p in [("a", "b"), ("a", "c"), ("d", "e")]}
    assert len(build_models(tmp_path / "d.db", apart, ONE)) == 2 and len(calls) == 1


def test_connected_images_left_out_are_tried_from_other_pairs_and_the_best_counts(
    monkeypatch, tmp_path
):
    calls = runs(monkeypatch, [[model("ab")], [model("abcd")], [model("abc")]])
    models = build_models(tmp_path / "d.db", PAIRS, ONE)
    assert [initial for _, initial in calls] == [None, ("a", "b"), ("c", "d")]  # each image once
    assert [m.num_reg_images() for m in models] == [4]


def test_the_global_mapper_has_no_first_pair_and_runs_once(monkeypatch, tmp_path):
    calls = runs(monkeypatch, [[model("ab")]])
    options = dataclasses.replace(ONE, mapper="global")
    assert len(build_models(tmp_path / "d.db", PAIRS, options)) == 1
    assert calls == [("global", None)]


def test_what_a_run_of_the_mapper_made_is_told_in_numbers(monkeypatch):
    attempt = attempt_of([model("abcd"), model("xy")], "incremental")  # pyright: ignore
    assert (attempt.mapper, attempt.initial_pair) == ("incremental", None)
    assert attempt.registered == [4, 2]


@pytest.mark.parametrize(
    ("images", "registered", "whole"),
    [
        (10, 9, True),
        (10, 8, False),
        (40, 36, True),
        (40, 35, False),
        (41, 21, True),
        (41, 20, False),
    ],
)
def test_a_tenth_may_be_missing_and_half_of_many_images(
    monkeypatch, tmp_path, images, registered, whole
):
    names = "".join(chr(200 + k) for k in range(images))
    chain = {pair: two_view() for pair in zip(names[:-1], names[1:], strict=True)}
    found: list[Any] = [model(names[:registered])]
    assert complete(found, chain.keys()) == whole
    calls = runs(monkeypatch, [found] * 5)
    build_models(tmp_path / "d.db", chain, ONE)
    assert (len(calls) == 1) == whole


def test_without_a_model_what_pairs_connect_is_missing():
    assert complete([], []) and not complete([], [("a", "b")])


def test_a_draft_is_adjusted_less_often_and_takes_no_image_for_a_single_pair():
    colmap, draft = (
        mapper.incremental_options(dataclasses.replace(ONE, draft=draft)) for draft in (False, True)
    )
    assert colmap.structure_less_registration_fallback
    assert not draft.structure_less_registration_fallback
    assert draft.ba_global_frames_ratio > colmap.ba_global_frames_ratio
    assert draft.ba_global_max_refinements < colmap.ba_global_max_refinements
    assert draft.ba_global_function_tolerance > colmap.ba_global_function_tolerance
    usual = pycolmap.IncrementalPipelineOptions()
    assert colmap.ba_global_max_refinements == usual.ba_global_max_refinements
    assert colmap.ba_global_function_tolerance == usual.ba_global_function_tolerance
    assert draft.ba_global_points_ratio > colmap.ba_global_points_ratio


def test_points_of_a_draft_have_a_parallax_in_pixels_or_colmaps_own_angle():
    """A turn by an angle a moves what lies in the middle of a photo by f tan(a)."""
    cameras = [
        pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[f, f, 4, 4])
        for f in (90, 500, 7000)
    ]
    angle = np.radians(narrowest_angle_deg(cameras, 1.25))
    assert 500 * np.tan(angle) == pytest.approx(1.25 * LEAST_PARALLAX)
    assert (
        narrowest_angle_deg(cameras[2:], 1.25)
        == mapper.incremental_options(ONE).mapper.filter_min_tri_angle
    )


@pytest.mark.parametrize("draft", [False, True])
def test_only_a_draft_asks_for_more_parallax(monkeypatch, tmp_path, scene, draft):
    write_database(tmp_path / "d.db", scene.images, scene.results, Cameras())
    given = []
    monkeypatch.setattr(
        mapper.pycolmap, "incremental_mapping", lambda *args, **_: given.append(args[3]) or {}
    )
    options = dataclasses.replace(ONE, draft=draft, scale=10.0)
    assert mapper.run_mapper(tmp_path / "d.db", options) == []
    own = mapper.incremental_options(options).mapper.filter_min_tri_angle
    p = given[0]
    assert p.triangulation.min_angle == p.mapper.filter_min_tri_angle
    assert (p.mapper.filter_min_tri_angle > own) == draft


def test_a_model_that_brings_few_new_images_is_left_out(monkeypatch, tmp_path):
    """Of two models of the same images, the one with more points stays."""
    found = [model("abc"), model("abcde"), model("fgh", 5), model("fgh", 9), model("xyza")]
    found += [model("wva"), model("uv", 9), model("ut", 5)]
    monkeypatch.setattr(
        mapper.pycolmap, "incremental_mapping", lambda *_, **__: dict(enumerate(found))
    )
    models = mapper.run_mapper(tmp_path / "d.db", ONE)
    assert models == [found[1], found[4], found[3], found[6]]


def planar_results(count=5, points=200):
    """Views of one plane, exact."""
    rng = np.random.default_rng(0)
    xyz = np.c_[rng.uniform(-1, 1, (points, 2)), np.zeros(points)]
    seen = {}
    for k in range(count):
        turn = Rotation.from_euler("yx", [(k - 2) * 12, 4 * (k % 2)], degrees=True)
        local = turn.apply(xyz) + [0, 0, 6]
        seen[k] = local[:, :2] / local[:, 2:] * 1280 + [511.5, 383.5]
    return seen


def matched_everywhere(names, seen):
    """Matches of all pairs of photos that show the same 200 points at these pixels."""
    cells = np.tile(np.arange(200, dtype=np.int32)[:, None], (1, 2))
    return {
        (names[i], names[j]): PairResult(
            pair=(names[i], names[j]),
            cells=cells,
            keypoints0=seen[i].astype(np.float32),
            keypoints1=seen[j].astype(np.float32),
            plane=np.zeros(200, np.int32),
            homographies=np.eye(3)[None],
            num_tentative=200,
            num_dropped=0,
            status=Status.VERIFIED,
        )
        for i, j in itertools.combinations(range(5), 2)
    }


def test_a_planar_scene_is_mapped_whole(tmp_path, scene):
    """A facade: every initial pair is planar."""
    results = matched_everywhere(scene.names, planar_results())
    write_database(tmp_path / "d.db", scene.images, results, scene.cameras)
    two_views = verified(tmp_path / "d.db", ONE)
    assert all(view.planar for view in two_views.values())
    models = build_models(tmp_path / "d.db", two_views, ONE)
    assert models[0].num_reg_images() == 5
    assert models[0].compute_mean_reprojection_error() < 0.01


def test_two_view_rotations_spreads_and_angles_are_the_scenes(tmp_path, scene):
    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    images = list(scene.truth.images.values())
    centre = {i.name: i.projection_center() for i in images}
    rotation = {i.name: i.cam_from_world().rotation.matrix() for i in images}
    points = np.asarray([p.xyz for p in scene.truth.points3D.values()])
    for (a, b), view in verified(tmp_path / "d.db", ONE).items():
        assert a < b and 0 < view.geometry.spread <= 1 and not view.planar
        assert rotation_angle_deg(view.geometry.rotation, rotation[b] @ rotation[a].T) < 0.1
        rays = [centre[name] - points for name in (a, b)]
        sine = np.linalg.norm(np.cross(*rays), axis=1)
        sine /= np.prod([np.linalg.norm(r, axis=1) for r in rays], axis=0)
        assert view.tri_angle_deg == pytest.approx(np.degrees(np.median(np.arcsin(sine))), abs=1)


def test_dropped_pairs_are_gone_for_the_mapper_but_their_matches_stay(tmp_path, scene):
    import pycolmap

    path = tmp_path / "d.db"
    write_database(path, scene.images, scene.results, scene.cameras)
    all_pairs = sorted(verified(path, ONE))
    lonely = scene.names[0]
    dropped = [pair for pair in all_pairs if lonely in pair]
    drop_pairs(path, dropped)
    left = read_two_views(path)
    assert sorted(left) == [pair for pair in all_pairs if pair not in dropped]
    with pycolmap.Database.open(path) as db:
        assert len(db.read_all_matches()[0]) == len(all_pairs)
    models = build_models(path, left, ONE)
    assert lonely not in {models[0].image(i).name for i in models[0].reg_image_ids()}


@pytest.mark.parametrize("initial", [None, 0])
def test_a_given_initial_pair_gives_the_same_scene(tmp_path, scene, initial):
    write_database(tmp_path / "d.db", scene.images, scene.results, scene.cameras)
    if initial is None:
        assert map_database(tmp_path / "d.db", ONE)[0].num_reg_images() == 5
        return
    pair = initial_pairs(verified(tmp_path / "d.db", ONE))[initial]
    assert mapper.run_mapper(tmp_path / "d.db", ONE, start=pair)[0].num_reg_images() == 5


def test_a_given_pair_gives_one_model_not_one_per_try(tmp_path, scene):
    """COLMAP starts every further model from the given pair too, up to 50 times."""
    small = [dataclasses.replace(i, name=f"s{k}.png") for k, i in enumerate(scene.images[:3])]
    other = {
        (f"s{i}.png", f"s{j}.png"): dataclasses.replace(
            scene.results[scene.names[i], scene.names[j]], pair=(f"s{i}.png", f"s{j}.png")
        )
        for i, j in ((0, 1), (0, 2), (1, 2))
    }
    path = tmp_path / "d.db"
    write_database(path, small + scene.images, scene.results | other, scene.cameras)
    two_views = verified(path, ONE)
    pair = next(p for p in initial_pairs(two_views) if p[0] in scene.names)
    assert [m.num_reg_images() for m in mapper.run_mapper(path, ONE, start=pair)] == [5]
    assert [m.num_reg_images() for m in build_models(path, two_views, ONE)] == [5, 3]


def test_models_of_other_images_stay_beside_a_better_attempt(monkeypatch, tmp_path):
    runs(monkeypatch, [[model("ab"), model("xy")], [model("abcdef")]])
    models = build_models(tmp_path / "d.db", PAIRS, ONE)
    assert [m.names for m in models] == [list("abcdef"), list("xy")]


def test_images_that_are_taken_out_leave_no_point_with_fewer_than_two_observations(rendered):
    model = noisy_model(rendered, 0.0)
    names = registered(model)
    before = {k: point.track.length() for k, point in model.points3D.items()}
    take_out(model, {"1.png", "3.png", "of no image"})
    assert registered(model) == names - {"1.png", "3.png"}
    left = {k: point.track.length() for k, point in model.points3D.items()}
    assert min(left.values()) >= 2 and left.keys() < before.keys()
    seen = {e.image_id for point in model.points3D.values() for e in point.track.elements}
    assert seen == set(model.reg_image_ids())


def test_photos_from_nearly_one_place_are_mapped(tmp_path, scene):
    """The rays of no pair meet at the 4 degrees that COLMAP asks for at the least."""
    rng = np.random.default_rng(0)
    xyz = np.c_[rng.uniform(-1, 1, (200, 2)), rng.uniform(4, 7, 200)]
    seen = [(xyz - [0.06 * k, 0, 0]) @ np.diag([1280.0, 1280, 1]) for k in range(5)]
    seen = [each[:, :2] / each[:, 2:] + [511.5, 383.5] for each in seen]
    results = matched_everywhere(scene.names, seen)
    write_database(tmp_path / "d.db", scene.images, results, scene.cameras)
    views = verified(tmp_path / "d.db", ONE)
    assert 1 < max(view.tri_angle_deg for view in views.values()) < 4
    (found,) = mapper.run_mapper(tmp_path / "d.db", ONE)
    assert found.num_reg_images() == 5 and found.compute_mean_reprojection_error() < 0.01
