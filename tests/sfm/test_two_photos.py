"""Laws of two photos: significance, views from one place, turns, and what further passes bring."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import rng_of, seeds

from jaxsfm.config import preset
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile, inspect_image, read_image
from jaxsfm.io.orientation import CODES, to_stored
from jaxsfm.io.pairs import PairResult
from jaxsfm.io.photos import PhotoView, read_view
from jaxsfm.matching.extraction import image_features
from jaxsfm.sfm.refine.pair_alignment import AlignedMatches
from jaxsfm.sfm.two_photos import further_passes, matching_pass, pair_passes
from jaxsfm.sfm.two_photos.further_passes import MOST_PROPOSALS, proposals
from jaxsfm.sfm.two_photos.matching_pass import MatchingPass, moved
from jaxsfm.sfm.two_photos.pair_passes import HALF_SURE, POWER, confidence, match_photos
from jaxsfm.sfm.two_photos.rectification import (
    Located,
    affine_between,
    rectified_views,
    transformed,
    view_change,
)


def photo(size: tuple[int, int], orientation: int = 1) -> ImageFile:
    return ImageFile(
        name="a.png", path=Path("a.png"), size=size, sha256="0" * 64, orientation=orientation
    )


def affine(rng: np.random.Generator, scale: float = 1.0) -> np.ndarray:
    """A map that turns by any angle, stretches up to twice, and moves."""
    turn, slant = rng.uniform(-math.pi, math.pi), rng.uniform(0.7, 1.4)
    cos, sin = math.cos(turn), math.sin(turn)
    matrix = np.eye(3)
    matrix[:2, :2] = scale * np.asarray([[cos, -sin], [sin, cos]]) @ np.diag([slant, 1 / slant])
    matrix[:2, 2] = rng.uniform(-50, 50, 2)
    return matrix


@settings(max_examples=50, deadline=None)
@given(st.integers(5, 60), st.integers(60, 900), st.floats(1e-4, 0.3))
def test_significance_is_the_expected_number_of_such_planes_by_chance(members, candidates, chance):
    """Counted with whole numbers: n C(n, k) C(k, 4) p^(k - 4)."""
    ways = candidates * math.comb(candidates, members) * math.comb(members, 4)
    expected = -(math.log10(ways) + (members - 4) * math.log10(chance))
    assert matching_pass.neg_log10_nfa(members, candidates, chance) == pytest.approx(expected)


@settings(max_examples=50, deadline=None)
@given(st.integers(20, 90), st.integers(200, 900), st.floats(1e-4, 1e-2))
def test_significance_grows_with_members_and_falls_with_what_was_tried(members, candidates, chance):
    ours = matching_pass.neg_log10_nfa(members, candidates, chance)
    assert matching_pass.neg_log10_nfa(members + 1, candidates, chance) > ours
    assert matching_pass.neg_log10_nfa(members, candidates, chance * 2) < ours
    if members < candidates / 2:
        assert matching_pass.neg_log10_nfa(members, 2 * candidates, chance) < ours


def test_four_matches_are_no_significance():
    assert matching_pass.neg_log10_nfa(4, 100, 1e-3) == -math.inf
    assert matching_pass.total(np.asarray([-math.inf, matching_pass.BY_CHANCE, 0.0])) == 0
    assert matching_pass.total(np.asarray([matching_pass.BY_CHANCE + 3, 2.0])) == 3


def test_cells_of_an_enlarged_photo_are_counted_in_larger_cells():
    cells = np.arange(64)  # 8 x 8 fine cells are 4 x 4 coarse ones, and 2 x 2 of twice their size
    assert [matching_pass._coarse_cells(cells, 8, times) for times in (1.0, 2.0)] == [16, 4]


def test_confidence_grows_from_none_to_certainty():
    values = [confidence(e) for e in (0.0, 30.0, 60.0, 200.0, 4000.0)]
    assert values == sorted(values) and values[0] < 0.05 and values[-1] > 0.99


def test_the_odds_of_a_pair_grow_with_a_power_of_its_significance():
    odds = [c / (1 - c) for c in map(confidence, (HALF_SURE, 2 * HALF_SURE, 8 * HALF_SURE))]
    assert odds == pytest.approx([1, 2**POWER, 8**POWER])
    assert confidence(633.0) == pytest.approx(0.9, abs=0.001)  # docs/decisions/hard-pairs.md


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from([0.3, 1.0, 2.5]))
def test_an_affine_map_is_found_among_false_matches(seed, scale):
    rng = rng_of(seed)
    truth = affine(rng, scale)
    xy0 = rng.uniform(0, 500, (120, 2))
    xy1 = transformed(truth, xy0)
    xy1[:30] = rng.uniform(0, 500, (30, 2))
    found = affine_between(Located(xy0, xy1))
    assert found is not None
    np.testing.assert_allclose(transformed(found, xy0), transformed(truth, xy0), atol=1.0)


@settings(max_examples=60, deadline=None)
@given(st.floats(-179, 179), st.floats(0.2, 5.0), st.floats(0.2, 5.0), st.floats(0, math.pi), seeds)
def test_a_view_changes_by_a_turn_after_a_stretch_along_two_axes(turn, a, b, axis, seed):
    def rotation(angle: float) -> np.ndarray:
        cos, sin = math.cos(angle), math.sin(angle)
        return np.asarray([[cos, -sin], [sin, cos]])

    matrix = np.eye(3)
    stretch = rotation(axis) @ np.diag([a, b]) @ rotation(-axis)
    matrix[:2, :2] = rotation(math.radians(turn)) @ stretch
    matrix[:2, 2] = rng_of(seed).uniform(-500, 500, 2)
    change = view_change(matrix)
    assert change.scale == pytest.approx(max(a, b, 1 / a, 1 / b))
    assert change.turn == pytest.approx(abs(turn), abs=1e-6)
    back = view_change(np.linalg.inv(matrix))
    assert back == pytest.approx(change, abs=1e-6)


def test_matches_that_determine_no_view_give_none():
    line = np.column_stack([np.arange(9.0), np.zeros(9)])
    mirrored = rng_of(0).uniform(0, 300, (40, 2))
    for xy0, xy1 in ((line[:2], line[:2]), (line, line), (mirrored, mirrored * [-1, 1])):
        assert rectified_views(Located(xy0, xy1), photo((400, 300)), photo((400, 300))) is None


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([0.3, 0.8, 1.3, 3.0]))
def test_matching_points_lie_at_one_pixel_of_the_common_view(seed, scale):
    rng = rng_of(seed)
    truth = affine(rng, scale)
    xy0 = rng.uniform([100, 100], [300, 250], (60, 2))
    both = Located(xy0, transformed(truth, xy0))
    views = rectified_views(both, photo((800, 600)), photo((2000, 2000)), size=500)
    assume(views is not None)  # photo 1 may not show the points
    at0, at1 = (transformed(view.matrix, xy) for view, xy in zip(views, both, strict=True))
    np.testing.assert_allclose(at0, at1, atol=1e-6)
    assert views[0].size == views[1].size and max(views[0].size) == 500
    frame = views[int(np.linalg.det(truth[:2, :2]) > 1)]
    assert frame.matrix[0, 1] == frame.matrix[1, 0] == 0  # the larger picture is only cut


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_common_view_does_not_depend_on_the_order_of_the_photos(seed):
    rng = rng_of(seed)
    xy0 = rng.uniform([100, 100], [300, 250], (60, 2))
    xy1 = transformed(affine(rng, 1.5), xy0)
    a, b = photo((800, 600)), photo((900, 900))
    one, other = rectified_views(Located(xy0, xy1), a, b), rectified_views(Located(xy1, xy0), b, a)
    assume(one is not None and other is not None)
    assert one is not None and other is not None
    np.testing.assert_allclose(one[0].matrix, other[1].matrix, atol=1e-6)
    np.testing.assert_allclose(one[1].matrix, other[0].matrix, atol=1e-6)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory, photos):
    """A photo, a part of it zoomed in 1.3 times, the same turned by a quarter, and another one."""
    folder = tmp_path_factory.mktemp("two")
    whole = photos[3][:384, :512, ::-1]
    part = cv2.resize(whole[60:300, 80:400], (416, 312), interpolation=cv2.INTER_CUBIC)
    shown = {"whole": whole, "part": part, "turned": np.rot90(part), "other": photos[0][..., ::-1]}
    for name, pixels in shown.items():
        cv2.imwrite(str(folder / f"{name}.png"), pixels)
    return {name: inspect_image(folder / f"{name}.png") for name in shown}


@pytest.mark.parametrize("orientation", CODES)
def test_a_view_of_the_whole_photo_is_the_photo(pictures, orientation):
    image = dataclasses.replace(pictures["whole"], orientation=orientation)
    view = PhotoView(np.eye(3), image.upright_size)
    working = read_image(image, max_size=4096, upright=True)
    seen = read_view(image, view)
    np.testing.assert_array_equal(seen.rgb, working.rgb)
    assert seen.scale == (1.0, 1.0) and seen.used is None
    back = np.linalg.inv(view.from_stored(image))
    np.testing.assert_allclose(back, to_stored(image.size, orientation), atol=1e-9)


def test_what_lies_outside_the_photo_is_not_used(pictures):
    shifted = np.eye(3)
    shifted[0, 2] = 100.0
    seen = read_view(pictures["whole"], PhotoView(shifted, (512, 384)))
    assert seen.used is not None
    assert not seen.used[:, :98].any() and seen.used[:, 102:].all()


def test_a_reduced_view_has_the_photos_means(pictures):
    half = np.asarray([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    seen = read_view(pictures["whole"], PhotoView(half, (256, 192)))
    whole = read_image(pictures["whole"], max_size=4096).rgb.astype(float)
    means = whole.reshape(192, 2, 256, 2, 3).mean((1, 3))
    assert np.abs(seen.rgb - means).max() <= 1


@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_view_is_the_photo_after_quarter_turns(pictures, quarters):
    view = further_passes.turned_view(pictures["whole"], quarters)
    whole = read_image(pictures["whole"], max_size=4096).rgb
    np.testing.assert_array_equal(
        read_view(pictures["whole"], view).rgb, np.rot90(whole, -quarters)
    )


def result(xy0: np.ndarray, h: np.ndarray, plane: np.ndarray) -> PairResult:
    """Matches on planes h (p, 3, 3), without noise."""
    on_plane = np.stack([transformed(h[p], xy[None])[0] for p, xy in zip(plane, xy0, strict=True)])
    return PairResult(
        pair=("a", "b"),
        cells=np.zeros((len(xy0), 2), np.int32),
        keypoints0=xy0.astype(np.float32),
        keypoints1=on_plane.astype(np.float32),
        plane=plane,
        homographies=h,
        num_tentative=len(xy0),
        num_dropped=0,
        status=Status.VERIFIED,
    )


def test_moved_matches_stay_on_their_planes_and_come_back():
    rng = rng_of(3)
    h = np.stack([affine(rng), affine(rng, 2.0)])
    found = result(rng.uniform(0, 300, (40, 2)), h, np.arange(40) % 2)
    m0, m1 = affine(rng, 0.5), affine(rng, 2.0)
    there = moved(found, m0, m1)
    for p in range(2):
        mine = there.plane == p
        at = np.column_stack([there.keypoints0[mine], np.ones(20)]) @ there.homographies[p].T
        np.testing.assert_allclose(at[:, :2] / at[:, 2:], there.keypoints1[mine], atol=0.01)
    back = moved(there, np.linalg.inv(m0), np.linalg.inv(m1))
    np.testing.assert_allclose(back.keypoints0, found.keypoints0, atol=1e-3)
    np.testing.assert_allclose(back.keypoints1, found.keypoints1, atol=1e-3)


def test_proposals_are_ordered_by_significance_and_none_is_made_twice():
    rng = rng_of(5)
    h = np.stack([affine(rng, s) for s in (0.5, 1.0, 2.0)])
    a, b = photo((800, 600)), photo((800, 600))
    looks = [
        MatchingPass(
            result(rng.uniform(0, 400, (60, 2)), h, np.arange(60) % 3), np.asarray(significance)
        )
        for significance in ([20.0, 90.0, 5.0], [30.0, 80.0, 10.0])
    ]
    made = [affine_between(each) for each in proposals(looks, (a, b))]
    assert len(made) <= MOST_PROPOSALS
    # A whole look mixes its planes; the strongest single plane comes before the others.
    single = [int(np.argmin([np.abs(m - x).max() for x in h])) for m in made if m is not None]
    exact = [k for k, m in zip(single, made, strict=True) if np.abs(m - h[k]).max() < 1e-3]
    assert exact == [1, 0, 2]


@pytest.fixture
def few_sizes(monkeypatch):
    """No enlarging and views of one size: each size of a picture is a program to compile."""
    monkeypatch.setattr(pair_passes, "MOST_ENLARGED", 1.0)
    monkeypatch.setattr(pair_passes, "SIZE", pair_passes.SMALL_SIZE)
    monkeypatch.setattr(further_passes, "SIZES", (pair_passes.SMALL_SIZE,))


@pytest.mark.slow
def test_a_turned_part_is_matched_by_further_passes(weights, pictures, few_sizes):
    # Each further octave would be some nine programs to compile.
    config = dataclasses.replace(preset("default"), octaves=1)
    first, other = (
        image_features(weights, pictures[name], config=config) for name in ("whole", "turned")
    )
    found = match_photos(weights, first, other, config=config)
    at = (found.result.keypoints0.astype(float) - [80, 60] + 0.5) * 1.3 - 0.5
    # np.rot90 turns counterclockwise: (x, y) becomes (y, width - 1 - x).
    at = np.column_stack([at[:, 1], 415 - at[:, 0]])
    error = np.linalg.norm(found.aligned.keypoints1 - at, axis=1)
    assert found.passes > 1 and found.confidence > 0.9
    assert np.median(error) < 1.5 and (error < 10).mean() > 0.9
    once = match_photos(
        weights, first, other, config=dataclasses.replace(config, max_rectified_planes=0)
    )
    assert once.passes == 1 and once.significance < found.significance / 2


@pytest.mark.slow
def test_photos_of_different_things_stay_without_confidence(weights, pictures, few_sizes):
    config = dataclasses.replace(preset("default"), octaves=1)  # as above
    both = [image_features(weights, pictures[name], config=config) for name in ("whole", "other")]
    assert match_photos(weights, both[0], both[1], config=config).confidence < 0.3


@pytest.mark.slow
def test_a_strong_pair_is_matched_once(weights, pictures):
    config = dataclasses.replace(preset("default"), octaves=1)
    features = image_features(weights, pictures["part"], config=config)
    found = match_photos(weights, features, features, config=config)
    assert found.passes == 1 and found.significance > 1.05 * pair_passes.STRONG


def fake_pass(significance: float) -> SimpleNamespace:
    counts = SimpleNamespace(num_inliers=0, num_tentative=100)
    return SimpleNamespace(significance=significance, result=counts)


@pytest.mark.parametrize(("significance", "closer"), [(14.9, False), (15.1, True)])
def test_if_a_pair_must_be_worth_it_further_passes_follow_a_sign_at_some_scale(
    monkeypatch, significance, closer
):
    """`jaxsfm match` looks closer at any weak pair; runs do not."""
    features = SimpleNamespace(image=photo((8, 8)))
    weak, found, asked = (fake_pass(e) for e in (2.0, significance, 99.0))
    monkeypatch.setattr(pair_passes, "is_conclusive", lambda first: False)
    monkeypatch.setattr(pair_passes, "match_once", lambda *_, **__: weak)
    monkeypatch.setattr(pair_passes, "at_other_scales", lambda *_, **__: [found])
    monkeypatch.setattr(pair_passes, "_search_further", lambda *given, **__: [*given[2], asked])
    planes: list[float] = []

    def match_planes_rectified(_, best: Any) -> further_passes.PlanePasses:
        planes.append(best.significance)
        return further_passes.PlanePasses([], 0)

    monkeypatch.setattr(pair_passes, "match_planes_rectified", match_planes_rectified)
    nothing = AlignedMatches(np.empty((0, 2)), np.empty(0, bool))
    monkeypatch.setattr(pair_passes, "_aligned", lambda *_: nothing)
    monkeypatch.setattr(pair_passes, "seen_alike", lambda *_: True)
    given: Any = (None, features, features)
    config = preset("default")
    least = match_photos(*given, config=config, worth_further=pair_passes.HOPELESS)
    assert (least.passes == 3) == closer == bool(planes)
    planes.clear()
    assert match_photos(*given, config=config, worth_further=15.2).passes == 2 and not planes
    assert match_photos(*given, config=config).passes == 3
