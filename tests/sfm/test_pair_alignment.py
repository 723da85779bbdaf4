"""Laws of aligned matches: what the plane says, to a fraction of a pixel, or nothing."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import ndimage
from tolerances import ALIGNED_PX

from jaxsfm.config import preset
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairResult
from jaxsfm.sfm.refine import device_images
from jaxsfm.sfm.refine.pair_alignment import align, align_matches, local_map

SIDE = 320
H = np.asarray([[1.1, -0.25, 40.0], [0.2, 0.95, -20.0], [1e-4, -5e-5, 1.0]])
"""Image 0 to image 1, working pixels."""


def texture(seed: int) -> np.ndarray:
    """Detail at every size, so that every octave has something to align."""
    rng = np.random.default_rng(seed)
    layers = [
        size * ndimage.gaussian_filter(rng.normal(size=(SIDE, SIDE)), size) for size in (1.5, 4, 12)
    ]
    return (100 + 60 * np.sum(layers, axis=0)).astype(np.float32)


def mapped(h: np.ndarray, xy: np.ndarray) -> np.ndarray:
    q = np.column_stack([xy, np.ones(len(xy))]) @ h.T
    return q[:, :2] / q[:, 2:]


def seen_by(h: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The second image: gain and offset differ too."""
    y, x = np.mgrid[:SIDE, :SIDE]
    back = mapped(np.linalg.inv(h), np.column_stack([x.ravel(), y.ravel()]).astype(float))
    values = ndimage.map_coordinates(image, back[:, ::-1].T, order=3, mode="nearest")
    return (0.4 * values.reshape(SIDE, SIDE) + 30).astype(np.float32)


def original(xy: np.ndarray, scale: float) -> np.ndarray:
    return (xy + 0.5) * scale - 0.5


def pair(noise_px: float, scale0: float, scale1: float) -> tuple[PairResult, np.ndarray]:
    """Matches of the plane, the second keypoints off by noise; and where they belong."""
    grid = np.mgrid[60:260:12, 60:260:12].reshape(2, -1).T + 0.3
    truth = mapped(H, grid)
    keep = ((truth > 40) & (truth < SIDE - 40)).all(axis=1)
    grid, truth = grid[keep], truth[keep]
    noise = np.random.default_rng(1).uniform(-noise_px, noise_px, grid.shape)

    def to_original(s: float) -> np.ndarray:
        return np.asarray([[s, 0, 0.5 * s - 0.5], [0, s, 0.5 * s - 0.5], [0, 0, 1]])

    n = len(grid)
    result = PairResult(
        pair=("a", "b"),
        cells=np.zeros((n, 2), np.int32),
        keypoints0=original(grid, scale0).astype(np.float32),
        keypoints1=original(truth + noise, scale1).astype(np.float32),
        plane=np.ones(n, np.int32),
        homographies=np.stack(
            [np.eye(3), to_original(scale1) @ H @ np.linalg.inv(to_original(scale0))]
        ),
        num_tentative=n,
        num_dropped=0,
        status=Status.VERIFIED,
    )
    return result, original(truth, scale1)


@pytest.mark.parametrize(("scale0", "scale1"), [(1.0, 1.0), (2.0, 0.75)])
def test_matches_end_where_the_plane_puts_them(scale0, scale1):
    result, truth = pair(6.0, scale0, scale1)
    image = texture(0)
    found = align_matches(
        result,
        image,
        seen_by(H, image),
        (scale0, scale0),
        (scale1, scale1),
        octaves=4,
        max_error_px=10.0,
    )
    errors = np.linalg.norm(found.keypoints1 - truth, axis=1)[found.aligned] / scale1
    assert found.aligned.mean() > 0.9
    assert np.median(errors) < 2 * ALIGNED_PX  # the warped image was interpolated too
    assert np.mean(errors < 0.5) > 0.97


def test_a_size_puts_each_image_on_the_device_once_and_reads_the_host_once(monkeypatch):
    result, _ = pair(2.0, 1.0, 1.0)
    image, counts = texture(0), {"images": 0, "reads": 0}
    put, get = jax.device_put, jax.device_get

    def counted(x):
        counts["images"] += sum(leaf.shape[2:] == (1,) for leaf in jax.tree.leaves(x))
        return put(x)

    def read(x):
        counts["reads"] += 1
        return get(x)

    monkeypatch.setattr(device_images, "CHUNK", 64)
    monkeypatch.setattr(jax, "device_put", counted)
    monkeypatch.setattr(jax, "device_get", read)
    assert result.num_inliers > 2 * 64
    found = align_matches(
        result, image, seen_by(H, image), (1.0, 1.0), (1.0, 1.0), octaves=3, max_error_px=10.0
    )
    assert found.aligned.mean() > 0.9
    assert counts == {"images": 3 * 2, "reads": 3}


def test_smaller_sizes_bring_home_what_is_further_off():
    result, _ = pair(8.0, 1.0, 1.0)
    image = texture(0)
    aligned = [
        align_matches(
            result,
            image,
            seen_by(H, image),
            (1.0, 1.0),
            (1.0, 1.0),
            octaves=octaves,
            max_error_px=12.0,
        ).aligned.mean()
        for octaves in (1, 3)
    ]
    assert aligned[0] < 0.6 < 0.85 < aligned[1]


def test_what_has_nothing_in_common_stays_where_it_was():
    result, _ = pair(3.0, 1.0, 1.0)
    found = align_matches(
        result, texture(0), texture(1), (1.0, 1.0), (1.0, 1.0), octaves=4, max_error_px=10.0
    )
    assert found.aligned.mean() < 0.05
    still = ~found.aligned
    np.testing.assert_allclose(found.keypoints1[still], result.keypoints1[still], atol=1e-4)


def test_no_match_ends_further_from_its_plane_than_allowed():
    """The image lies 3 px beside where the homography says."""
    result, truth = pair(2.0, 1.0, 1.0)
    image = texture(0)
    beside = np.asarray([[1, 0, 3.0], [0, 1, 0], [0, 0, 1]]) @ H
    ends = [
        align_matches(
            result,
            image,
            seen_by(beside, image),
            (1.0, 1.0),
            (1.0, 1.0),
            octaves=4,
            max_error_px=limit,
        )
        for limit in (2.0, 4.0)
    ]
    off = [np.linalg.norm(e.keypoints1 - truth, axis=1)[e.aligned] for e in ends]
    assert off[0].max(initial=0) < 2 and len(off[0]) < 0.3 * len(truth)
    assert off[1].max() < 4 and len(off[1]) > 0.8 * len(truth)


def test_the_affinity_is_the_homographys_derivative():
    xy = np.random.default_rng(0).uniform(0, SIDE, (20, 2))
    step = 1e-4
    columns = [
        (mapped(H, xy + step * e) - mapped(H, xy - step * e)) / (2 * step) for e in np.eye(2)
    ]
    at, got = local_map(np.broadcast_to(7.0 * H, (20, 3, 3)), xy)
    np.testing.assert_allclose(at, mapped(H, xy))
    np.testing.assert_allclose(got, np.stack(columns, axis=2), rtol=1e-6)


def test_without_octaves_keypoints_stay_where_they_were():
    """And the images are not even read."""
    result, _ = pair(3.0, 1.0, 1.0)
    gone = ImageFile(path=Path("gone.png"), name="gone.png", size=(SIDE, SIDE), sha256="")
    found = align(result, gone, gone, config=preset("paper"))
    assert not found.aligned.any()
    np.testing.assert_array_equal(found.keypoints1, result.keypoints1)


def test_alignment_is_no_part_of_what_a_stored_match_depends_on():
    config = preset("default")
    for setting in ("aligned_octaves", "max_rectified_planes"):
        assert config.matching() == dataclasses.replace(config, **{setting: 0}).matching()
