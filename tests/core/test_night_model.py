"""The synthetic night's light: its constants and what they do."""

import jax
import numpy as np
import pytest
from compiled import compiled

from jaxsfm.core import night


def test_the_constants_of_the_model_are_what_they_were():
    """Relocalizers were trained with them."""
    np.testing.assert_allclose(night.AMBIENT, [0.0042, 0.0051, 0.0072], rtol=1e-12)
    assert night.LAMPS == ((1.25, 0.9, 0.5), (1.1, 1.0, 0.8), (0.85, 1.05, 1.0))
    assert (night.GAMMA, night.NUM_LAMPS, night.SATURATED_SHARE) == (2.2, 6, 0.01)
    assert (night.FULL_WELL, night.MIN_FULL_SCALE, night.READ_NOISE) == (20_000.0, 100.0, 2.0)
    assert (night.BLUR_PX, night.BLUR_RADIUS) == (0.3, 4)


@pytest.mark.parametrize("severity", [0.0, 1.0])
def test_no_severity_is_the_photo_and_a_night_is_darker(severity):
    photo = np.full((40, 60, 3), 128.0, np.float32)
    seen = compiled(night.night)(jax.random.key(0), photo, np.float32(severity))
    assert seen.shape == photo.shape and seen.min() >= 0 and seen.max() <= 255
    if severity == 0:
        np.testing.assert_array_equal(seen, photo)
    else:
        assert np.median(seen) < 128 and seen.std() > 10
