"""Laws of the synthetic night."""

import numpy as np
import pytest

from jaxsfm.bench.scenes import synthetic_night


@pytest.fixture(scope="module")
def photo(photos):
    import cv2

    return cv2.resize(photos[0], (240, 160), interpolation=cv2.INTER_AREA)


def contrast(image: np.ndarray, photo: np.ndarray) -> float:
    """Correlation of gradients with the day photo's: what of the scene can still be seen."""
    a, b = (np.diff(x.astype(float).mean(2), axis=1).ravel() for x in (image, photo))
    return float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 else 0.0


def test_severity_zero_is_the_day(photo):
    got = synthetic_night(photo, severity=0, seed=1)
    assert np.array_equal(got, photo) and got is not photo


@pytest.mark.parametrize("options", [{}, {"denoise": False}, {"jpeg": False}])
def test_the_same_seed_gives_the_same_night(photo, options):
    before = photo.copy()
    first = synthetic_night(photo, severity=2, seed=3, **options)
    assert first.shape == photo.shape and first.dtype == np.uint8
    assert np.array_equal(first, synthetic_night(photo, severity=2, seed=3, **options))
    assert not np.array_equal(first, synthetic_night(photo, severity=2, seed=4, **options))
    assert np.array_equal(photo, before)


def test_less_can_be_seen_as_it_gets_darker(photo):
    seen = [
        contrast(synthetic_night(photo, severity=s, seed=0, denoise=False, jpeg=False), photo)
        for s in (0, 1, 2, 3, 4)
    ]
    assert seen == sorted(seen, reverse=True) and seen[1] > 0.5 and seen[-1] < 0.3


def test_the_end_is_black(photo):
    image = synthetic_night(photo, severity=6, seed=0, denoise=False, jpeg=False)
    assert np.median(image) < 40
    assert abs(contrast(image, photo)) < 0.1


def test_lamps_saturate_and_the_rest_is_dark(photo):
    image = synthetic_night(photo, severity=1, seed=0)
    assert (image.max(2) > 240).mean() > 0.002
    assert image.mean() < photo.mean()


def test_denoising_smooths(photo):
    raw, smooth = (
        synthetic_night(photo, severity=2.5, seed=0, denoise=d, jpeg=False) for d in (False, True)
    )
    rough = [np.abs(np.diff(x.astype(float), axis=0)).mean() for x in (raw, smooth)]
    assert rough[1] < rough[0]


@pytest.mark.parametrize("severity", [-1, -0.1])
def test_negative_severity_is_refused(photo, severity):
    with pytest.raises(ValueError, match="severity"):
        synthetic_night(photo, severity=severity, seed=0)


def test_other_images_are_refused(photo):
    with pytest.raises(ValueError, match="rgb"):
        synthetic_night(photo[..., 0], severity=1, seed=0)
