"""A synthetic night: a day photo as a camera would see it under a few lamps.

It is a model and no real night, so every result made with it is called `synthetic`. Its steps are:

1. Light: from severity 0 to 1 the day fades into a dim bluish ambience with a few lamps. Each lamp
   has its colour, its reach and a glare.
2. Blur of 0.3 px per unit of severity, because the exposure is longer.
3. Exposure: the brightest hundredth saturates; a pixel at saturation holds 20 000 electrons at
   severity 0 and a tenth of that per unit. Photon noise is Poisson, read noise 2 electrons.
4. Gain: the gain ends at 100 electrons for full scale, so from severity 2.3 on the image gets
   darker. At severity 5 a pixel holds less than one electron, and only read noise is left.
5. Encoding with gamma 2.2 and 8 bits, then optionally a camera's denoising and JPEG.
"""

import cv2
import numpy as np

from jaxsfm.core.night import (
    AMBIENT,
    BLUR_PX,
    FULL_WELL,
    GAMMA,
    LAMPS,
    MIN_FULL_SCALE,
    NUM_LAMPS,
    READ_NOISE,
    SATURATED_SHARE,
)


def _lamp_light(shape: tuple[int, int], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Light on the surfaces and glare in front of them, float64 (h, w, 3); 1 is daylight."""
    height, width = shape
    diagonal = np.hypot(height, width)
    y, x = np.mgrid[:height, :width]
    light = np.broadcast_to(np.asarray(AMBIENT), (height, width, 3)).copy()
    glare = np.zeros((height, width, 3))
    for _ in range(NUM_LAMPS):
        at = rng.uniform([0.05, 0.05], [0.95, 0.75]) * (width, height)
        reach = rng.uniform(0.06, 0.16) * diagonal
        colour = np.asarray(LAMPS)[rng.integers(len(LAMPS))] * rng.uniform(0.4, 1.0)
        square = (x - at[0]) ** 2 + (y - at[1]) ** 2
        light += (1 / (1 + square / reach**2) ** 2)[..., None] * colour
        glare += np.exp(-square / (2 * (0.006 * diagonal) ** 2))[..., None] * colour
    return light, glare


def synthetic_night(
    rgb: np.ndarray, *, severity: float, seed: int, denoise: bool = True, jpeg: bool = True
) -> np.ndarray:
    """A photo at a synthetic night, uint8 (h, w, 3) RGB.

    Args:
      rgb: uint8 (h, w, 3), a day photo.
      severity: 0 is the photo itself, 1 a clean night, 2 noisy, 3 dark, 5 nothing but noise.
      seed: seed of the lamps' places and of the noise.
      denoise: whether the camera removes noise.
      jpeg: whether the camera stores JPEG.

    Raises:
      ValueError: `severity` is negative, or `rgb` is not such an image.
    """
    if severity < 0:
        raise ValueError(f"severity must be at least 0; got {severity}")
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"rgb must be uint8 (h, w, 3); got {rgb.dtype} {rgb.shape}")
    if severity == 0:
        return rgb.copy()
    rng = np.random.default_rng(seed)
    light, glare = _lamp_light(rgb.shape[:2], rng)
    dusk = min(severity, 1.0)
    radiance = (rgb / 255.0) ** GAMMA * ((1 - dusk) + dusk * light) + dusk * glare
    radiance = cv2.GaussianBlur(radiance, (0, 0), BLUR_PX * severity)
    white = (1 - dusk) + dusk * float(np.quantile(radiance.max(2), 1 - SATURATED_SHARE))
    full = FULL_WELL * 10.0**-severity
    electrons = rng.poisson(np.minimum(radiance / max(white, 1e-6), 1.0) * full)
    electrons = electrons + rng.normal(0.0, READ_NOISE, rgb.shape)
    signal = np.clip(electrons / max(full, MIN_FULL_SCALE), 0.0, 1.0)
    image = np.round(255 * signal ** (1 / GAMMA)).astype(np.uint8)
    if denoise:
        strength = float(np.clip(5 * severity, 3, 12))
        image = cv2.fastNlMeansDenoisingColored(image, None, strength, strength, 5, 11)
    if jpeg:
        quality = int(np.clip(95 - 10 * severity, 50, 95))
        ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        assert ok
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert decoded is not None
        image = np.ascontiguousarray(decoded[..., ::-1])
    return image
