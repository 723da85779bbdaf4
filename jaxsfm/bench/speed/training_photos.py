"""The photographs that the relocalizer in the package was trained on, out of other packages.

    pip install scikit-image scikit-learn matplotlib
    python -m jaxsfm.bench.speed.training_photos DIR

None of them is in a benchmark's data.
"""

import sys
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import skimage.data
from sklearn.datasets import load_sample_image

SCIKIT_IMAGE = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket")


def photographs() -> dict[str, np.ndarray]:
    """uint8 RGB or grey, by name."""
    found = {name: getattr(skimage.data, name)() for name in SCIKIT_IMAGE}
    found["motorcycle_left"] = skimage.data.stereo_motorcycle()[0]
    found |= {name: load_sample_image(f"{name}.jpg") for name in ("china", "flower")}
    hopper = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    decoded = cv2.imread(str(hopper))
    assert decoded is not None, hopper
    found["hopper"] = decoded[..., ::-1]
    return found


def main() -> None:
    """Write them as PNG."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, rgb in photographs().items():
        three = rgb if rgb.ndim == 3 else np.repeat(rgb[..., None], 3, axis=2)
        cv2.imwrite(str(folder / f"{name}.png"), np.ascontiguousarray(three[..., ::-1]))


if __name__ == "__main__":
    main()
