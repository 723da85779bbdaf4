"""Altered photos: alterations, pairs that are drawn from sets, and the benchmark of copies."""

import json

import cv2
import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.bench.alterations import Alteration, alter
from jaxsfm.bench.drawn_pairs import (
    NEAR_PX,
    STRANGERS,
    DrawnPair,
    PosedPhoto,
    drawn_pairs,
    posed_photos,
    true_fundamental_matrix,
)
from jaxsfm.bench.matches import Matches
from jaxsfm.bench.strecha_sets import place_of, read_sets
from jaxsfm.bench.turns import copies, means
from jaxsfm.cli.main import main
from jaxsfm.colmap.poses import CameraPose


def ramp(width=200, height=120):
    """A photo whose red and green are its own coordinates."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([x, y, np.zeros_like(x)], axis=2).astype(np.uint8)


@pytest.mark.parametrize(
    "alteration",
    [
        Alteration(),
        Alteration(corner=(0.1, 0.25), side=0.5),
        Alteration(scale=0.5),
        Alteration(scale=0.37),
        *(Alteration(corner=(0.2, 0.1), side=0.6, scale=0.5, quarters=k) for k in range(4)),
    ],
    ids=str,
)
def test_pixels_of_an_altered_photo_come_from_where_its_matrix_says(alteration):
    altered = alter(ramp(), alteration)
    height, width = altered.rgb.shape[:2]
    x, y = (side.ravel() for side in np.meshgrid(np.arange(width), np.arange(height)))
    at = np.stack([x, y, np.ones_like(x)], axis=1) @ altered.to_original.T
    shown = altered.rgb[..., :2].reshape(-1, 2)
    assert np.abs(shown - at[:, :2]).max() <= 1.0  # whole numbers of colours


def test_the_size_of_a_pixel_is_that_of_the_reduction():
    altered = alter(ramp(), Alteration(side=0.5, scale=0.25, quarters=1))
    assert altered.rgb.shape[:2] == (25, 15) and altered.pixel == pytest.approx(4)


def test_a_night_depends_on_its_seed_and_moves_nothing():
    day, night, again, other = (
        alter(ramp(), Alteration(severity=s, scale=0.5), seed=seed)
        for s, seed in ((0.0, 0), (2.0, 0), (2.0, 0), (2.0, 1))
    )
    assert (night.rgb == again.rgb).all() and (night.rgb != other.rgb).any()
    assert night.rgb.mean() < day.rgb.mean()
    np.testing.assert_array_equal(night.to_original, day.to_original)


@pytest.mark.parametrize(
    "wrong",
    [{"corner": (0.6, 0.0), "side": 0.5}, {"side": 0.0}, {"scale": 2.0}, {"scale": 0.0}],
    ids=str,
)
def test_what_cannot_be_done_to_a_photo_is_refused(wrong):
    with pytest.raises(ValueError, match="got"):
        alter(ramp(), Alteration(**wrong))


def posed(scene, rng, path):
    camera = np.asarray([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    rotation = cv2.Rodrigues(rng.normal(size=3) * 0.2)[0]
    return PosedPhoto(scene, path, camera, CameraPose(rotation, rng.normal(size=3) * 0.3))


@pytest.mark.parametrize("seed", range(5))
def test_points_lie_on_their_true_epipolar_lines(seed, tmp_path):
    rng = rng_of(seed)
    first, second = (posed("a", rng, tmp_path / name) for name in ("0.png", "1.png"))
    points = rng.uniform([-2, -2, 4], [2, 2, 9], size=(40, 3))

    def seen(photo):
        x = (points - photo.pose.centre) @ photo.pose.rotation.T @ photo.camera.T
        return x[:, :2] / x[:, 2:]

    f = true_fundamental_matrix(first, second)
    x0, x1 = (np.c_[seen(photo), np.ones(len(points))] for photo in (first, second))
    assert np.abs((x1 @ f * x0).sum(1)).max() < 1e-9 * np.abs(f).max() * 1e6
    altered = alter(ramp(), Alteration(scale=0.25))
    at = (seen(second) - altered.to_original[:2, 2]) / np.diag(altered.to_original)[:2]
    pair = DrawnPair(first, second, Alteration(scale=0.25))
    for off, least, most in ((0.0, 1.0, 1.0), (20 * NEAR_PX, 0.0, 0.4)):
        moved = at + off * rng.normal(size=at.shape)
        share = pair.near_share(altered, Matches(seen(first), moved, 0.0))
        assert least <= share <= most
    strange = pair._replace(second=second._replace(scene="b"))
    assert strange.near_share(altered, Matches(seen(first), at, 0.0)) == 0


@pytest.fixture(scope="module")
def two_sets(tmp_path_factory):
    rng, folder = rng_of(0), tmp_path_factory.mktemp("none")
    return [[posed(name, rng, folder / f"{k}.png") for k in range(6)] for name in ("a", "b")]


def test_more_pairs_begin_with_the_same_ones(two_sets):
    few, many = (list(drawn_pairs(two_sets, n)) for n in (10, 60))
    assert [pair.name for pair in few] == [pair.name for pair in many[:10]]


def test_pairs_are_of_two_photos_and_a_third_of_them_of_two_places(two_sets):
    pairs = list(drawn_pairs(two_sets, 300))
    assert all(p.first.path != p.second.path or not p.one_place for p in pairs)
    assert np.mean([not p.one_place for p in pairs]) == pytest.approx(STRANGERS, abs=0.08)
    assert {p.alteration.quarters for p in pairs} == {0, 1, 2, 3}
    one_set = list(drawn_pairs(two_sets[:1], 20))
    assert all(pair.one_place for pair in one_set)


def test_photos_of_two_sets_of_one_place_are_not_drawn_together(tmp_path):
    names = ("castle-P19", "entry-P10", "Herz-Jesus-P8")
    rng = rng_of(0)
    sets = [[posed(name, rng, tmp_path / f"{k}.png") for k in range(6)] for name in names]
    pairs = list(drawn_pairs(sets, 200))
    drawn = {frozenset((p.first.scene, p.second.scene)) for p in pairs if not p.one_place}
    assert drawn == {frozenset(("castle-P19", names[2])), frozenset(("entry-P10", names[2]))}
    places = [place_of(name) for name in (*names, "fountain-P11", "Herz-Jesus-P25", "a")]
    assert places == ["castle", "castle", "Herz-Jesus", "castle", "Herz-Jesus", "a"]


def test_photos_of_a_set_have_their_camera_in_our_pixels(strecha):
    (given,) = read_sets(strecha, None)
    photos = posed_photos(given)
    assert [photo.path.name for photo in photos] == sorted(given.truth)
    k = np.loadtxt(strecha / "room" / "images" / "K.txt")
    k[:2, 2] -= 0.5
    np.testing.assert_allclose(photos[0].camera, k)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("quarters", [0, 1])
def test_copies_show_things_larger_by_their_scale_and_know_their_places(quarters, scale):
    both = copies(ramp(), quarters, scale)
    assert both.photo.pixel / both.copy.pixel == pytest.approx(scale)
    at = rng_of(0).uniform(20, 100, (30, 2))
    xy0, xy1 = (
        (np.c_[at, np.ones(30)] @ np.linalg.inv(each.to_original).T)[:, :2] for each in both
    )
    assert both.errors(Matches(xy0, xy1, 0.0)).max() < 1e-9
    off = both.errors(Matches(xy0, xy1 + [3.0, 4.0], 0.0))
    np.testing.assert_allclose(off, 5.0 * both.copy.pixel / max(e.pixel for e in both))


def test_shares_are_averaged_for_each_kind_of_copy():
    rows = [
        {"method": "a", "quarters": q, "scale": 2.0, "share": {"mean": share}}
        for q, share in ((0, 0.2), (0, 0.4), (1, 1.0))
    ]
    found = means(rows)["a"]
    assert found == {"turned 0, scale 2": pytest.approx(0.3), "turned 90, scale 2": 1.0}


def test_copies_of_real_photos_are_matched(strecha, tmp_path, capsys):
    out = tmp_path / "figures.json"
    args = ["--root", str(strecha), "--sets", "room/images", "--every", "2", "--turns", "0,90"]
    args += ["--scales", "0.5,1", "--methods", "rootsift", "--json", str(out)]
    assert main(["bench", "turns", *args]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 2 * 2 * 2
    whole = [row for row in rows if row["scale"] == 1]
    assert all(row["share"]["mean"] > 0.8 and row["matches"]["mean"] > 50 for row in whole)
    assert "turned 90, scale 0.5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("bench", "args", "word"),
    [
        ("turns", ["--turns", "45"], "--turns: '45'"),
        ("turns", ["--scales", "0"], "--scales: '0'"),
        ("turns", ["--scales", "two"], "--scales: 'two'"),
        ("turns", ["--every", "0"], "--every"),
        ("turns", ["--sets", "castle"], "no set 'castle'"),
        ("turns", ["--methods", "orb"], "no method 'orb'"),
        ("confidence", ["--pairs", "0"], "--pairs"),
        ("confidence", ["--methods", "rootsift"], "no method 'rootsift'"),
        ("confidence", ["--sets", "castle"], "no set 'castle'"),
        ("confidence", ["--diagram", "a.gif"], "--diagram"),
    ],
)
def test_wrong_options_are_named(bench, args, word, strecha, capsys):
    assert main(["bench", bench, "--root", str(strecha), *args]) == 2
    assert word in capsys.readouterr().err
