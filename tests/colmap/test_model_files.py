"""What COLMAP's readers make of damaged model files, and what is refused before or after them.

Each kind of damage is here with what COLMAP alone does, which is the reason for the check.
"""

import dataclasses
import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from foreign_model import camera, exact_model
from mapped import map_database

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_files import read_model, read_models, write_model, write_models
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import colour_points
from jaxsfm.errors import UserError
from jaxsfm.io.images import WorkingImage

ONE = MapOptions(refine_intrinsics=False, threads=1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A binary model of four images, two cameras and 20 points."""
    folder = tmp_path_factory.mktemp("whole")
    exact_model([camera("PINHOLE"), camera("OPENCV", 2)], points=20).write_binary(folder)
    return folder


def copied(whole: Path, folder: Path, file: str, data: bytes) -> Path:
    """A copy of a model in which one file has other content."""
    for path in whole.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / file).write_bytes(data)
    return folder


def put(data: bytes, at: int, layout: str, *values: float) -> bytes:
    """Data with other values from the byte `at` on."""
    new = struct.pack("<" + layout, *values)
    return data[:at] + new + data[at + len(new) :]


# Where values of the first entry are. A file begins with the number of its entries (8 bytes).
CAMERA_PARAMS = 32
IMAGE_POSE, IMAGE_NAME = 12, 72
IMAGE_KEYPOINTS = IMAGE_NAME + len("a.jpg\0")
"""The number of keypoints; then come x, y and the point of each one."""
FRAME_POSE, FRAME_IMAGES = 16, 72
POINT_XYZ, POINT_ERROR, POINT_TRACK = 16, 43, 51
ENDLESS = {
    "no points": ("points3D.bin", lambda d: b"", "it ends too early"),
    "too many points": ("points3D.bin", lambda d: put(d, 0, "Q", 1000), "it ends too early"),
    "an endless track": (
        "points3D.bin", lambda d: put(d, POINT_TRACK, "Q", 2**60), "it ends too early",
    ),
    "an endless name": (
        "images.bin", lambda d: d[:IMAGE_NAME] + b"a" * 99, "a name without an end",
    ),
    "too many keypoints": (
        "images.bin", lambda d: put(d, IMAGE_KEYPOINTS, "Q", 2**31), "it ends too early",
    ),
    "too many images of a frame": (
        "frames.bin", lambda d: put(d, FRAME_IMAGES, "I", 2**32 - 1), "it ends too early",
    ),
}  # fmt: skip
ALONE = """
import resource, sys
import pycolmap

used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 28), used + (1 << 28)))
resource.setrlimit(resource.RLIMIT_CPU, (4, 4))
try:
    pycolmap.Reconstruction(sys.argv[1])
except MemoryError:
    print("memory ended")
"""


@pytest.mark.parametrize("damage", list(ENDLESS))
def test_what_colmap_reads_without_an_end_is_refused_before(tmp_path, monkeypatch, whole, damage):
    file, changed, why = ENDLESS[damage]
    bad = copied(whole, tmp_path, file, changed((whole / file).read_bytes()))
    monkeypatch.setattr(pycolmap, "Reconstruction", None)
    with pytest.raises(
        UserError, match=f"{re.escape(str(tmp_path))}: not a readable COLMAP model .{file}: {why}"
    ):
        read_model(bad)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory in this way")
@pytest.mark.parametrize("damage", list(ENDLESS))
def test_colmap_alone_reads_it_without_an_end(tmp_path, whole, damage):
    """For files of some kilobytes, COLMAP takes more than 256 MB of memory or many seconds."""
    file, changed, _ = ENDLESS[damage]
    bad = copied(whole, tmp_path, file, changed((whole / file).read_bytes()))
    done = subprocess.run([sys.executable, "-c", ALONE, str(bad)], capture_output=True, text=True)
    assert done.stdout == "memory ended\n" or done.returncode < 0


KEYPOINT = IMAGE_KEYPOINTS + 8
CAMERA_WIDTH = 16
UNNOTICED = {
    "a camera without pixels": ("cameras.bin", lambda d: put(d, CAMERA_WIDTH, "Q", 0), "width"),
    "an endless camera": ("cameras.bin", lambda d: put(d, CAMERA_WIDTH + 8, "Q", 2**40), "height"),
    "no focal length": ("cameras.bin", lambda d: put(d, CAMERA_PARAMS, "d", 0), "positive; got 0"),
    "a negative one": ("cameras.bin", lambda d: put(d, CAMERA_PARAMS + 8, "d", -9), "positive"),
    "no name": ("images.bin", lambda d: d.replace(b"a.jpg", b""), "'' names no file"),
    "one photo twice": ("images.bin", lambda d: d.replace(b"a.jpg", b"sub//b.jpg"), "one folder"),
    "a photo that is a folder": ("images.bin", lambda d: d.replace(b"a.jpg", b"z"), "one folder"),
    "half of a camera": ("cameras.bin", lambda d: d[:-30], "it ends too early"),
    "half of a rig": ("rigs.bin", lambda d: d[:-1], "it ends too early"),
    "a byte less": ("points3D.bin", lambda d: d[:-1], "it ends too early"),
    "more bytes": ("frames.bin", lambda d: d + b"\0", "it goes on after its last entry"),
    "a point less": ("points3D.bin", lambda d: put(d, 0, "Q", 19), "it goes on after"),
    "a rotation of zero": ("frames.bin", lambda d: put(d, FRAME_POSE, "4d", 0, 0, 0, 0), "length"),
    "a camera that is nowhere": ("frames.bin", lambda d: put(d, FRAME_POSE, "d", np.nan), "absurd"),
    "an old pose": ("images.bin", lambda d: put(d, IMAGE_POSE, "d", np.inf), "absurd"),
    "a huge focal length": ("cameras.bin", lambda d: put(d, CAMERA_PARAMS, "d", 1e300), "absurd"),
    "a keypoint that is nowhere": ("images.bin", lambda d: put(d, KEYPOINT, "d", np.nan), "absurd"),
    "a keypoint that is far off": ("images.bin", lambda d: put(d, KEYPOINT, "d", 1e300), "absurd"),
    "a point that is far off": ("points3D.bin", lambda d: put(d, POINT_XYZ, "d", 1e300), "absurd"),
    "a name in another encoding": ("images.bin", lambda d: put(d, IMAGE_NAME, "B", 0xFF), "UTF-8"),
}


@pytest.mark.parametrize("damage", list(UNNOTICED))
def test_what_colmap_does_not_notice_is_refused(tmp_path, whole, damage):
    file, changed, why = UNNOTICED[damage]
    bad = copied(whole, tmp_path, file, changed((whole / file).read_bytes()))
    assert pycolmap.Reconstruction(bad).num_reg_images() == 4
    with pytest.raises(
        UserError, match=f"{re.escape(str(tmp_path))}: not a readable COLMAP model .{file}: .*{why}"
    ):
        read_model(bad)


@pytest.mark.parametrize("file", ["rigs.bin", "frames.bin"])
def test_rigs_with_sensors_are_followed_to_their_end(tmp_path, file):
    """The poses of sensors are in the rigs, and a frame has an image of each sensor."""
    options = pycolmap.SyntheticDatasetOptions(num_cameras_per_rig=2, num_frames_per_rig=2)
    (tmp_path / "whole").mkdir()
    pycolmap.synthesize_dataset(options).write_binary(tmp_path / "whole")
    assert read_model(tmp_path / "whole").num_reg_images() == 8
    (tmp_path / "bad").mkdir()
    data = (tmp_path / "whole" / file).read_bytes()
    bad = copied(tmp_path / "whole", tmp_path / "bad", file, data[:-1])
    assert pycolmap.Reconstruction(bad).num_reg_images() == 8
    with pytest.raises(UserError, match=f"{file}: it ends too early"):
        read_model(bad)


def test_keypoints_of_a_point_that_is_not_there_are_refused(tmp_path, whole):
    """COLMAP reads such a model, but cannot count its observations."""
    bad = copied(whole, tmp_path, "points3D.bin", struct.pack("<Q", 0))
    model = pycolmap.Reconstruction(bad)
    with pytest.raises(IndexError, match="does not exist"):
        bundle_adjust(model, loss_px=1.0, refine_intrinsics=False, threads=1)
    with pytest.raises(
        UserError, match=f"{re.escape(str(tmp_path))}: .*its files do not fit together"
    ):
        read_model(bad)


def test_a_model_with_points_behind_cameras_is_read(tmp_path, whole):
    """COLMAP writes an error of 1e154 for such a point."""
    data = (whole / "points3D.bin").read_bytes()
    copied(whole, tmp_path, "points3D.bin", put(data, POINT_ERROR, "d", 1.3e154))
    assert read_model(tmp_path).num_points3D() == 20


@pytest.mark.parametrize(
    ("file", "old", "new", "why"),
    [
        ("images.txt", "a.jpg", "my a.jpg", "'my a.jpg' has a blank in it"),
        ("images.txt", r"\n[0-9.]+ ([0-9.]+) -1 ", r"\n1e300 \1 -1 ", "absurd"),
        ("cameras.txt", "PINHOLE 1024 768 900", "PINHOLE 1024 768 1e300", "absurd"),
        ("images.txt", "1 0.99", "1 0 0 0 0 0 0 0 1 a.jpg\n\n5 0.99", None),
    ],
    ids=["a blank in a name", "a keypoint", "a camera", "wrong ids"],
)
def test_text_models_are_checked_too(tmp_path, whole, file, old, new, why):
    pycolmap.Reconstruction(whole).write_text(tmp_path)
    text = (tmp_path / file).read_text()
    changed, count = re.subn(old, new, text, count=1)
    assert count
    (tmp_path / file).write_text(changed)
    message = "not a readable COLMAP model" + (f" .{file}: .*{why}" if why else "$")
    with pytest.raises(UserError, match=f"{re.escape(str(tmp_path))}: {message}"):
        read_model(tmp_path)


def test_blank_lines_and_comments_in_a_text_model_are_passed_over(tmp_path, whole):
    pycolmap.Reconstruction(whole).write_text(tmp_path)
    lines = (tmp_path / "images.txt").read_text().split("\n")
    changed = [*lines[:6], "", "# a comment with quite a few words in it, as people write them"]
    (tmp_path / "images.txt").write_text("\n".join([*changed, *lines[6:]]))
    assert read_model(tmp_path).num_reg_images() == 4


def test_written_models_replace_all_that_was_there(tmp_path, scene):
    smaller = pycolmap.Reconstruction(scene.truth)
    smaller.deregister_frame(min(smaller.reg_frame_ids()))
    folder = tmp_path / "sparse"
    (folder / "2").mkdir(parents=True)
    (folder / "2" / "stale.bin").write_text("x")
    write_models([scene.truth, smaller], folder)
    assert sorted(path.name for path in folder.iterdir()) == ["0", "1"]
    sizes = [pycolmap.Reconstruction(folder / str(i)).num_reg_images() for i in (0, 1)]
    assert sizes == [len(scene.names), len(scene.names) - 1]
    write_models([smaller], folder)
    assert [path.name for path in folder.iterdir()] == ["0"]
    write_models([], folder)
    assert not folder.exists()


def test_two_scenes_give_two_models_the_larger_first(tmp_path, scene):
    small = [dataclasses.replace(i, name=f"s{k}.png") for k, i in enumerate(scene.images[:3])]
    other = {
        (f"s{i}.png", f"s{j}.png"): dataclasses.replace(
            scene.results[scene.names[i], scene.names[j]], pair=(f"s{i}.png", f"s{j}.png")
        )
        for i, j in ((0, 1), (0, 2), (1, 2))
    }
    write_database(tmp_path / "d.db", small + scene.images, scene.results | other, scene.cameras)
    models = map_database(tmp_path / "d.db", ONE)
    assert [sorted(model_poses(m)) for m in models] == [scene.names, [i.name for i in small]]


@pytest.mark.parametrize("scale", [(1.0, 1.0), (2.0, 1.5)])
def test_a_point_has_the_colour_of_the_pixels_under_it(scene, scale):
    """Every image is black but for the pixels of its observations."""
    width, height = (round(side / s) for side, s in zip(scene.images[0].size, scale, strict=True))
    photos = {name: np.zeros((height, width, 3), np.uint8) for name in scene.names}
    lone = {}
    for index, image in enumerate(scene.truth.images.values()):
        pixels = {}
        for point in image.points2D:
            x, y = (int(c / s) for c, s in zip(point.xy, scale, strict=True))
            pixels.setdefault((x, y), []).append(point.point3D_id)
        for (x, y), ids in pixels.items():
            photos[image.name][y, x] = (ids[0] % 256, 40, 50 + 10 * index)
            for shared in ids if len(ids) > 1 else ():
                lone[shared] = False  # two points on one pixel
    model = pycolmap.Reconstruction(scene.truth)
    colour_points(model, lambda name: WorkingImage(photos[name], scale))
    checked = [p for p in model.points3D if lone.get(p, True)]
    assert len(checked) > 100
    for point_id in checked:
        assert tuple(model.point3D(point_id).color) == (point_id % 256, 40, 70)


def test_models_with_a_camera_that_their_database_has_not_are_refused(tmp_path, whole):
    shutil.copytree(whole, tmp_path / "sparse" / "0")
    write_database(tmp_path / "d.db", [], {}, Cameras())
    with pytest.raises(UserError, match=r"0: its camera \d is not in d\.db"):
        read_models(tmp_path / "sparse", tmp_path / "d.db")


def test_a_model_that_colmap_has_cut_off_is_not_taken_for_written(tmp_path):
    """On a full disk COLMAP writes what fits, and says nothing."""
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=3))

    class Cut:
        """The model, on a disk that is full after half of a file."""

        def __getattr__(self, name):
            return getattr(model, name)

        def write_binary(self, folder):
            model.write_binary(folder)
            points = folder / "points3D.bin"
            points.write_bytes(points.read_bytes()[: points.stat().st_size // 2])

    write_model(model, tmp_path)
    with pytest.raises(UserError, match="cannot be written .the model was cut off: points3D.bin"):
        write_model(Cut(), tmp_path)
