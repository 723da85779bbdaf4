"""A database that gets more images and matches: what is in it keeps its numbers."""

import numpy as np
import pycolmap
import pytest
from PIL import Image

from jaxsfm.colmap.cameras import Cameras, estimated_camera
from jaxsfm.colmap.database import (
    read_images,
    read_matches,
    write_database,
)
from jaxsfm.colmap.extend_database import add_images, add_matches, copy_database
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.core.types import Status
from jaxsfm.errors import UserError
from jaxsfm.io import atomic
from jaxsfm.io.images import ImageFile, inspect_image
from jaxsfm.io.pairs import Pair, PairResult

SIZE = (200, 160)


def images_in(folder, names: str) -> list[ImageFile]:
    for name in names:
        Image.new("RGB", SIZE).save(folder / f"{name}.png")
    return [inspect_image(folder / f"{name}.png", name=name) for name in names]


def grid(count: int) -> np.ndarray:
    """float32 pixels of `count` cells."""
    cells = np.arange(count)
    return np.stack([8 * (cells % 20) + 3, 8 * (cells // 20) + 4], axis=1).astype(np.float32)


def matched(pair: Pair, cells: np.ndarray) -> PairResult:
    """Cells with themselves."""
    return PairResult(
        pair=pair,
        cells=np.c_[cells, cells].astype(np.int32),
        keypoints0=grid(400)[cells],
        keypoints1=grid(400)[cells],
        plane=np.zeros(len(cells), np.int32),
        homographies=np.eye(3)[None],
        num_tentative=len(cells),
        num_dropped=0,
        status=Status.VERIFIED,
    )


@pytest.mark.parametrize("more", [0, 30])
def test_keypoints_that_are_known_are_the_old_ones_and_others_follow_them(tmp_path, more):
    old, known = images_in(tmp_path, "bc"), np.arange(50, 150)
    path = tmp_path / "copy.db"
    write_database(
        tmp_path / "database.db",
        old,
        {("b", "c"): matched(("b", "c"), known)},
        Cameras(sharing="photo"),
    )
    copy_database(tmp_path / "database.db", path, 2 * len(known))
    ids = {name: image_id for name, (image_id, _) in read_images(path).items()}
    with pycolmap.Database.open(path) as db:
        before = {name: db.read_keypoints(ids[name]) for name in "bc"}
    (new,) = images_in(tmp_path, "a")
    add_images(path, {"a": (new, estimated_camera([new]))})
    cells = np.r_[known[::-2], np.arange(200, 200 + more)]
    pairs = [("a", "b"), ("a", "c")]
    add_matches(path, {p: matched(p, cells) for p in pairs}, VerificationOptions(threads=1))
    with pycolmap.Database.open(path) as db:
        for name in "bc":
            after = db.read_keypoints(ids[name])
            assert len(after) == len(known) + more
            np.testing.assert_array_equal(after[: len(known)], before[name])
    for pair in pairs:
        both = read_matches(path, pair, verified=False)
        assert len(both[0]) == len(cells)
        for xy in both:
            np.testing.assert_array_equal(xy, grid(400)[cells])


def test_without_matches_nothing_is_verified(tmp_path):
    path = tmp_path / "database.db"
    write_database(path, images_in(tmp_path, "bc"), {}, Cameras(sharing="photo"))
    assert add_matches(path, {}, VerificationOptions(threads=1)) == {}


def test_a_full_disk_is_said_before_anything_is_written(tmp_path, monkeypatch):
    path = tmp_path / "database.db"
    path.write_bytes(bytes(1_000_000))
    usage = type("Usage", (), {"free": atomic.SPARE_BYTES + 3_000_000 + 64 * 10 - 1})
    monkeypatch.setattr(atomic.shutil, "disk_usage", lambda folder: usage)
    copy_database(path, tmp_path / "fits.db", 9)
    with pytest.raises(UserError, match="cannot be written"):
        copy_database(path, tmp_path / "copy.db", 10)
    assert not (tmp_path / "copy.db").exists()
