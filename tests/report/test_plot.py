"""Pictures of matches."""

import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io.pairs import PairResult
from jaxsfm.report.plot import COLOURS, draw_matches, encode_figure, save_figure

ONE = np.ones(2)


def result(planes: int, per_plane: int = 60) -> PairResult:
    """Matches on a grid, row by row from plane to plane."""
    n = planes * per_plane
    x, y = np.arange(n) % 20, np.arange(n) // 20
    xy = np.stack([10 + 14 * x, 8 + 10 * y], axis=1).astype(np.float32)
    return PairResult(
        pair=("a", "b"),
        cells=np.stack([np.arange(n)] * 2, axis=1).astype(np.int32),
        keypoints0=xy,
        keypoints1=xy + 3,
        plane=np.repeat(np.arange(planes), per_plane).astype(np.int32),
        homographies=np.broadcast_to(np.eye(3), (planes, 3, 3)),
        num_tentative=n,
        num_dropped=0,
        status=Status.VERIFIED if n else Status.NO_PLANE,
    )


def draw(planes: int, **scales):
    grey = np.full((200, 300, 3), 128, np.uint8)
    scales = {"scale0": ONE, "scale1": ONE} | scales
    return draw_matches(grey, grey[:150], result(planes), **scales)


def plane_colours(path) -> set[str]:
    """The plane colours that are among the picture's pixels."""
    rgb = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).reshape(-1, 3).astype(int)
    saturated = rgb[np.ptp(rgb, axis=1) > 90]
    near = [np.abs(saturated - np.multiply(to_rgb(c), 255)).max(1) < 40 for c in COLOURS]
    return {c for c, hits in zip(COLOURS, near, strict=True) if hits.sum() > 50}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".PNG"])
def test_a_picture_has_both_images_and_the_matches(tmp_path, suffix):
    path = tmp_path / f"a b{suffix}"
    save_figure(draw(1), path)
    picture = cv2.imread(str(path))
    assert picture.shape[1] == 14 * 120 and picture.std() > 10
    assert ((picture == 128).all(2)).mean() > 0.5


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_encoded_figure_is_the_file_that_is_written(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save_figure(draw(1), path)
    assert encode_figure(draw(1), suffix) == path.read_bytes()


def test_less_quality_takes_fewer_bytes_and_keeps_the_picture():
    fine, coarse = (encode_figure(draw(2), ".jpg", jpeg_quality=q) for q in (95, 60))
    assert len(coarse) < 0.8 * len(fine)
    a, b = (cv2.imdecode(np.frombuffer(d, np.uint8), 1).astype(int) for d in (fine, coarse))
    assert a.shape == b.shape and np.abs(a - b).mean() < 4


def test_an_unknown_format_is_refused():
    with pytest.raises(ValueError, match="must be .png or .jpg; got '.xyz'"):
        encode_figure(draw(1), ".xyz")


@pytest.mark.parametrize("planes", [0, 1, 3, 5])
def test_every_plane_has_its_colour(tmp_path, planes):
    save_figure(draw(planes), tmp_path / "a.png")
    assert plane_colours(tmp_path / "a.png") == set(COLOURS[:planes])


def test_dots_lie_on_their_pixels_under_any_scale():
    for scale in (1.0, 2.0):
        figure = draw(2, scale0=scale * ONE, scale1=scale * ONE)
        clouds = [c.get_offsets() for c in figure.axes[0].collections if len(c.get_offsets()) == 60]
        want = result(2)
        left = np.concatenate(clouds[::2])
        right = np.concatenate(clouds[1::2])
        np.testing.assert_allclose(left, (want.keypoints0 + 0.5) / scale - 0.5)
        np.testing.assert_allclose(
            right, (want.keypoints1 + 0.5) / scale - 0.5 + np.asarray([300, 0])
        )


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.txt"])
def test_an_unknown_suffix_is_refused(tmp_path, name):
    with pytest.raises(UserError, match="--plot .*use .png or .jpg"):
        save_figure(draw(1), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "folder.png").mkdir()
    for path in (tmp_path / "none" / "a.png", tmp_path / "folder.png"):
        with pytest.raises(UserError, match=f"--plot {re.escape(str(path))}: cannot be written"):
            save_figure(draw(1), path)


WRITE = """
import sys
sys.path.insert(0, sys.argv[2])
import {first}
from pathlib import Path
from test_plot import draw, save_figure
import pycolmap

for _ in range(3):
    save_figure(draw(2), Path(sys.argv[1]))
"""


@pytest.mark.parametrize("first", ["jaxsfm.colmap.database", "jaxsfm, pycolmap"])
def test_a_png_is_written_in_a_process_that_loaded_pycolmap(tmp_path, first):
    """With pycolmap before any other zlib, every deflate in the process corrupts the heap;

    `import jaxsfm` first is enough to prevent it."""
    folder = __file__.rpartition("/")[0]
    script = WRITE.format(first=first)
    command = [sys.executable, "-c", script, str(tmp_path / "a.png"), folder]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    assert plane_colours(tmp_path / "a.png") == set(COLOURS[:2])
