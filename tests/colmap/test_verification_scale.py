"""COLMAP's verification tolerates 4 pixels of the working image, whatever the photo's size."""

import numpy as np
import pycolmap
import pytest
from epipolar import two_views
from strategies import rng_of

from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.two_views import VerificationOptions, verify

APART = np.repeat([0.0, 6.0, 24.0], [200, 100, 100])
"""Pixels between matches and the geometry: none, between 4 and 8, more than either."""


def apart_from_their_lines(f, xy0, xy1, distance):
    """Second points moved across their epipolar lines, to a Sampson distance."""
    line1 = np.concatenate([xy0, np.ones((len(xy0), 1))], axis=1) @ f.T
    line0 = np.concatenate([xy1, np.ones((len(xy1), 1))], axis=1) @ f
    lengths = [np.linalg.norm(line[:, :2], axis=1) for line in (line0, line1)]
    normal = line1[:, :2] / lengths[1][:, None]
    step = distance * np.hypot(*lengths) / lengths[1]
    return xy1 + normal * (step * np.where(np.arange(len(xy0)) % 2, 1, -1))[:, None]


def write(path, xy0, xy1, *, zoom):
    """A database of two photos from one known camera."""
    camera = Intrinsics(model="PINHOLE", params=tuple(zoom * v for v in (600, 600, 320, 240)))
    count = np.arange(len(xy0), dtype=np.uint32)
    with pycolmap.Database.open(path) as db:
        camera_id = db.write_camera(camera.camera((640 * zoom, 480 * zoom)))
        ids = [db.write_image(pycolmap.Image(name=n, camera_id=camera_id)) for n in "ab"]
        for i, xy in zip(ids, (xy0, xy1), strict=True):
            db.write_keypoints(i, np.float32(zoom * xy))
        db.write_matches(*ids, np.stack([count, count], axis=1))


@pytest.mark.parametrize(
    "zoom, scale, kept", [(1, 1.0, 200), (1, 2.0, 300), (2, 1.0, 200), (2, 2.0, 200), (2, 4.0, 300)]
)
def test_the_tolerance_grows_with_the_photos_pixels_per_working_pixel(tmp_path, zoom, scale, kept):
    f, xy0, xy1 = two_views(rng_of(0), n=len(APART))
    write(tmp_path / "d.db", xy0, apart_from_their_lines(f, xy0, xy1, APART), zoom=zoom)
    verify(tmp_path / "d.db", VerificationOptions(threads=1, scale=scale, relative_poses=False))
    found = read_matches(tmp_path / "d.db", ("a", "b"), verified=True)[0]
    assert abs(len(found) - kept) < 20
