"""Sideways photos, and things that move with the camera."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxsfm.bench.synthetic import (
    TexturedPlane,
    arc,
    photo_textures,
    render,
    room,
    write_photo,
)
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import CameraPose, Poses, model_poses
from jaxsfm.config import preset
from jaxsfm.io.masks import mask_path
from jaxsfm.report.finished_run import read_run
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.evaluation import evaluate

pytestmark = pytest.mark.slow
SIZE, VIEWS = (320, 240), 5
LIMIT_DEG = 0.5
"""The cameras are not known. Half a pixel of the principal point turns all of them by 0.1 deg."""
CONFIG = dataclasses.replace(preset("default"), low_resolution=None)


def names() -> list[str]:
    return [f"{k}.png" for k in range(VIEWS)]


def truth() -> Poses:
    return dict(zip(names(), arc(VIEWS), strict=True))


def poster(pose: CameraPose, texture: np.ndarray) -> TexturedPlane:
    """A picture that moves with the camera, before the right third of the photo."""
    right, down, forward = pose.rotation
    return TexturedPlane(
        corner=pose.centre + forward + 0.15 * right - 0.4 * down,
        right=0.4 * right,
        down=0.8 * down,
        texture=texture,
    )


def reconstructed(photos: Path, out: Path, **options) -> tuple[RunReport, Poses]:
    report = reconstruct_folder(
        photos, out, config=CONFIG, options=RunOptions(threads=1, cameras="single", **options)
    )
    return report, model_poses(read_model(out / "sparse" / "0"))


def test_a_sideways_photo_is_turned_and_named(tmp_path):
    """It is stored turned by a quarter against the clock, without a note."""
    (tmp_path / "photos").mkdir()
    for name, pose in truth().items():
        rgb = render(room(), pose, SIZE)
        rgb = np.ascontiguousarray(np.rot90(rgb, 2)) if name == "2.png" else rgb
        write_photo(tmp_path / "photos" / name, rgb)
    report, poses = reconstructed(tmp_path / "photos", tmp_path / "out")
    assert report.turned == {"2.png": 180}
    assert poses.keys() == truth().keys()
    back = np.diag([-1.0, -1.0, 1.0])
    poses["2.png"] = poses["2.png"]._replace(rotation=back @ poses["2.png"].rotation)
    errors = evaluate(poses, truth())
    assert errors.position["mean"] < 0.01 and errors.rotation_deg["mean"] < LIMIT_DEG
    # Whoever reads the run again finds the features of the turned photo.
    assert read_run(tmp_path / "out").photos.recorded("2.png").orientation == 3


def test_what_is_masked_does_no_harm(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "masks").mkdir()
    picture = photo_textures()[1]
    for name, pose in truth().items():
        write_photo(
            tmp_path / "photos" / name, render([*room(), poster(pose, picture)], pose, SIZE)
        )
        white = poster(pose, np.full_like(picture, 255))
        black = [dataclasses.replace(p, texture=np.zeros_like(p.texture)) for p in room()]
        shown = render([*black, white], pose, SIZE)[..., 0]
        assert cv2.imwrite(str(mask_path(tmp_path / "masks", name)), 255 * (shown == 0))
    report, poses = reconstructed(tmp_path / "photos", tmp_path / "out", masks=tmp_path / "masks")
    assert poses.keys() == truth().keys() and report.verdict == "green"
    errors = evaluate(poses, truth())
    assert errors.position["mean"] < 0.01 and errors.rotation_deg["mean"] < LIMIT_DEG
    model = read_model(tmp_path / "out" / "sparse" / "0")
    for image in model.images.values():
        used = cv2.imread(str(mask_path(tmp_path / "masks", image.name)), cv2.IMREAD_GRAYSCALE)
        xy = np.asarray([p.xy for p in image.points2D if p.has_point3D()]).astype(int)
        assert len(xy) > 50 and (used[xy[:, 1], xy[:, 0]] > 0).all()
