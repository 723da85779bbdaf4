"""Photos of which no model can be made are told so at once."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxsfm.bench.synthetic import arc, render, room, write_photo
from jaxsfm.config import preset
from jaxsfm.io.entries import STAGES, STILL
from jaxsfm.io.still_pattern import LEAST_PHOTOS
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions

pytestmark = pytest.mark.slow
SIZE = (320, 240)
CONFIG = dataclasses.replace(preset("default"), low_resolution=None)


def reconstructed(photos: Path, out: Path, **options) -> RunReport:
    return reconstruct_folder(
        photos, out, config=CONFIG, options=RunOptions(threads=1, cameras="single", **options)
    )


def test_photos_from_one_place_end_the_run_after_verification(tmp_path):
    """The same camera centre, turned by up to 16 degrees, and a third of the photos rolled."""
    (tmp_path / "photos").mkdir()
    (pose,) = arc(1)
    for k in range(5):
        turn, _ = cv2.Rodrigues(np.radians([1.5 * (k % 2), 4.0 * k - 8, 5.0 * (k % 3 == 0)]))
        turned = pose._replace(rotation=turn @ pose.rotation)
        write_photo(tmp_path / "photos" / f"{k}.png", render(room(), turned, SIZE))
    report = reconstructed(tmp_path / "photos", tmp_path / "out")
    assert report.models == [] and report.no_model is not None
    assert "from one place" in report.no_model and "move sideways" in report.no_model
    assert [photo.stage for photo in report.lost] == ["no pose"] * 5
    # Nothing was mapped, and the database with the verified matches is there.
    assert [path.name for path in (tmp_path / "out" / STAGES).iterdir()] == ["verified"]
    assert (tmp_path / "out" / "database.db").is_file()


def test_what_stays_at_the_same_pixels_is_offered_as_a_mask(tmp_path, caplog):
    """All photos have the same picture in a corner, as a dashboard is in all photos of a drive."""
    (tmp_path / "photos").mkdir()
    picture = render(room(), arc(2)[1], SIZE)[:90, :120]
    for k, pose in enumerate(arc(LEAST_PHOTOS)):
        photo = render(room(), pose, SIZE)
        photo[150:, 200:] = picture
        write_photo(tmp_path / "photos" / f"{k}.png", photo)
    only = {"without": ("remap", "split", "pose-ambiguity", "refine", "register")}
    report = reconstructed(tmp_path / "photos", tmp_path / "out", **only)
    assert report.same_pixels is not None and report.same_pixels.photos == LEAST_PHOTOS
    assert f"--masks and the file {STILL}" in caplog.text
    mask = cv2.imread(str(tmp_path / "out" / STILL), cv2.IMREAD_GRAYSCALE)
    assert mask.shape == SIZE[::-1]
    assert (mask[170:, 220:] == 0).mean() > 0.7 and (mask[:130] == 0).mean() < 0.05
    before = (tmp_path / "out" / STILL).read_bytes()
    masked = reconstructed(tmp_path / "photos", tmp_path / "out", masks=tmp_path / "out" / STILL)
    assert masked.same_pixels is None and len(masked.identity.masks) == LEAST_PHOTOS
    assert masked.verdict == "green" and masked.models[0].registered == LEAST_PHOTOS
    assert (tmp_path / "out" / STILL).read_bytes() == before
