"""`bench homography`: readers, measures, and a run on a warped photograph."""

import json

import cv2
import numpy as np
import oracles
import pytest
from strategies import random_homography, rng_of

from jaxsfm.bench.homography import (
    area_under_curve,
    corner_error,
    match_errors,
    read_homography,
    read_sequence,
    warp,
)
from jaxsfm.cli.main import main
from jaxsfm.errors import UserError

SIZE = (320, 256)


@pytest.fixture(scope="module")
def truth():
    centre = np.asarray([[1, 0, -160.0], [0, 1, -128], [0, 0, 1]])
    turn = np.asarray([[1.02, 0.06, 4], [-0.05, 0.98, -3], [1e-4, -5e-5, 1]])
    return np.linalg.inv(centre) @ turn @ centre


@pytest.fixture(scope="module")
def root(photos, truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("planar")
    (folder / "wall").mkdir()
    photo = cv2.resize(photos[0], SIZE)
    cv2.imwrite(str(folder / "wall" / "img1.png"), photo)
    cv2.imwrite(str(folder / "wall" / "img2.png"), cv2.warpPerspective(photo, truth, SIZE))
    np.savetxt(folder / "wall" / "H1to2p", truth)
    return folder


def write_xml(path, h):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("H12", h)
    storage.release()


def test_all_layouts_give_the_same_pair(root, truth, tmp_path):
    images = {k: (root / "wall" / f"img{k}.png").read_bytes() for k in (1, 2)}
    for name, image in (("H1to2p", "img{}.png"), ("H1to2p.xml", "img{}.png"), ("H_1_2", "{}.png")):
        folder = tmp_path / name
        folder.mkdir()
        for k, data in images.items():
            (folder / image.format(k)).write_bytes(data)
        path = folder / name
        write_xml(path, truth) if name.endswith("xml") else np.savetxt(path, truth)
        (pair,) = read_sequence(folder)
        np.testing.assert_allclose(pair.h, truth, rtol=1e-12)
        assert pair.image1.name == image.format(2) and pair.name.endswith("1-2")


@pytest.mark.parametrize(
    "text", ["", "1 2 3", "<xml", "nan 0 0\n0 1 0\n0 0 1", "0 0 0\n0 0 0\n0 0 0"]
)
@pytest.mark.parametrize("name", ["H_1_2", "H1to2p.xml"])
def test_what_is_no_homography_is_named(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match="a homography"):
        read_homography(tmp_path / name)


def test_two_files_of_one_homography_are_one_pair(root, truth, tmp_path):
    for path in (root / "wall").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    write_xml(tmp_path / "H1to2p.xml", truth)
    assert len(read_sequence(tmp_path)) == 1
    write_xml(tmp_path / "H1to2p.xml", 2 * np.eye(3) + truth)
    with pytest.raises(UserError, match="contradicts"):
        read_sequence(tmp_path)


def test_a_missing_image_is_named(root, tmp_path):
    np.savetxt(tmp_path / "H_1_5", np.eye(3))
    with pytest.raises(UserError, match="image 1 is missing"):
        read_sequence(tmp_path)


@pytest.mark.parametrize("seed", range(5))
def test_errors_equal_the_slow_transfer(seed):
    rng = rng_of(seed)
    h = random_homography(rng, strength=0.1)
    xy = rng.uniform(-1, 1, size=(30, 2))
    np.testing.assert_allclose(warp(h, xy), oracles.transfer(h, xy), rtol=1e-6, atol=1e-9)
    shift = rng.normal(size=xy.shape)
    got = match_errors(h, xy, warp(h, xy) + shift)
    np.testing.assert_allclose(got, np.linalg.norm(shift, axis=1), rtol=1e-6)


def test_corner_errors_know_shifts_and_failures(truth):
    assert corner_error(truth, truth, SIZE) == 0
    shift = np.asarray([[1, 0, 3.0], [0, 1, 4], [0, 0, 1]])
    assert corner_error(shift @ truth, truth, SIZE) == pytest.approx(5)
    assert corner_error(None, truth, SIZE) == np.inf
    assert corner_error(np.asarray([[1, 0, 0], [0, 1, 0], [1.0, 0, 0]]), truth, SIZE) == np.inf


def test_area_under_the_curve_is_that_of_the_steps():
    errors = rng_of(3).uniform(0, 8, size=40)
    grid = np.linspace(0, 5, 100_001)
    curve = (errors[:, None] <= grid).mean(0)
    assert area_under_curve(errors, 5) == pytest.approx(curve.mean(), abs=1e-4)
    assert area_under_curve([0, 0], 3) == 1 and area_under_curve([None, 3], 3) == 0


@pytest.mark.slow
def test_a_warped_photograph_is_matched(root, tmp_path, capsys):
    out = tmp_path / "f.json"
    args = ["bench", "homography", "--root", str(root), "--json", str(out), "--seeds", "2"]
    default = "default-no-closer-looks"  # test_two_photos.py has those
    assert main([*args, "--methods", f"rootsift,paper,{default}"]) == 0
    figures = json.loads(out.read_text())
    rows = {row["method"]: row for row in figures["rows"]}
    assert rows["rootsift"]["accuracy"]["3"]["mean"] > 0.8
    for method in ("paper", default):
        row = rows[method]
        assert row["accuracy"]["10"]["mean"] > 0.8 and row["correct"]["3"]["mean"] > 50
        assert max(row["corner_error_px"]) < 5
        values = [row["accuracy"][t]["mean"] for t in ("1", "3", "5", "10")]
        assert values == sorted(values)
    assert "AUC" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (["--root", "/nowhere"], "no such folder"),
        (["--root", "{root}", "--methods", "paper", "--weights", "/nowhere"], "/nowhere: cannot"),
        (["--root", "{root}/wall"], "no sequences"),
        (["--root", "{root}", "--sets", "floor"], "no set 'floor'"),
    ],
)
def test_what_cannot_be_run_is_said(root, capsys, args, word):
    assert main(["bench", "homography", *(a.format(root=root) for a in args)]) == 2
    assert word in capsys.readouterr().err
