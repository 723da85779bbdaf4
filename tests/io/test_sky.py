"""Which pixels of a photo show the sky."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.io import orientation
from jaxsfm.io.images import inspect_image
from jaxsfm.io.sky import below_sky, sky

HEIGHT, WIDTH, HORIZON = 300, 400, 120
BLUE, WHITE = (90, 140, 220), (225, 228, 230)


def photo(colour=BLUE, *, noise: float = 2.0, seed: int = 0) -> np.ndarray:
    """A wall with details below a sky, uint8 (h, w, 3)."""
    rng = rng_of(seed)
    rgb = np.empty((HEIGHT, WIDTH, 3))
    rgb[:HORIZON] = colour
    wall = rng.integers(0, 255, (HEIGHT - HORIZON, WIDTH, 3))
    rgb[HORIZON:] = cv2.GaussianBlur(wall.astype(np.float32), (0, 0), 1.0)
    return np.clip(rgb + rng.normal(0, noise, rgb.shape), 0, 255).astype(np.uint8)


def share(found: np.ndarray, rows: slice) -> float:
    return float(found[rows].mean())


@pytest.mark.parametrize("colour", [BLUE, WHITE])
def test_a_smooth_bright_or_blue_region_at_the_top_is_the_sky(colour):
    found = sky(photo(colour))
    assert share(found, slice(0, HORIZON - 12)) > 0.99
    assert share(found, slice(HORIZON + 6, HEIGHT)) < 0.01


@pytest.mark.parametrize("case", ["dark", "rough", "not at the top", "small"])
def test_other_regions_are_not(case):
    rgb = photo((60, 60, 60) if case == "dark" else WHITE, noise=40.0 if case == "rough" else 2.0)
    if case == "not at the top":
        rgb[:20] = photo()[-20:]
    elif case == "small":  # a window of the size of half a hundredth
        wall = np.tile(photo()[HORIZON:], (2, 1, 1))[:HEIGHT]
        wall[:20, 100:130] = rgb[:20, 100:130]
        rgb = wall
    assert sky(rgb).mean() < 0.01


def test_noise_leaves_no_holes():
    """In windows of 9 x 9 pixels, one of fifteen is rough by chance."""
    assert sky(photo(noise=12.0))[: HORIZON - 12].all()


@pytest.mark.parametrize("code", orientation.CODES)
def test_the_sky_of_a_stored_photo_is_found_in_its_upright_picture(tmp_path, code):
    """Whatever the orientation, and at another size than that of the search."""
    upright = cv2.resize(photo(), None, fx=2.5, fy=2.5)
    stored = orientation.as_stored(upright, code)
    assert (orientation.upright(stored, code) == upright).all()
    path = Path(tmp_path / "a.png")
    cv2.imwrite(str(path), stored[..., ::-1])
    image = inspect_image(path)
    used = below_sky(dataclasses.replace(image, orientation=code))
    assert used.shape == stored.shape[:2] and used.dtype == bool
    back = orientation.upright(used, code)
    assert share(back, slice(0, 260)) < 0.02 and share(back, slice(330, 750)) > 0.98
