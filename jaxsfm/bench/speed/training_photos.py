"""Write the photographs that the package's relocalizer was trained on; other packages hold them.

    pip install scikit-image scikit-learn matplotlib
    python -m jaxsfm.bench.speed.training_photos DIR

None of these photographs is in a benchmark's data.
"""

import sys
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import skimage.data

SCIKIT_IMAGE = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket")


def photographs() -> dict[str, np.ndarray]:
    """The photographs by name, uint8 (h, w, 3) RGB or (h, w) grey."""
    # scikit-learn is needed here only, so it is no dependency of the package.
    from sklearn.datasets import load_sample_image  # pyright: ignore[reportMissingImports]

    found = {name: getattr(skimage.data, name)() for name in SCIKIT_IMAGE}
    found["motorcycle_left"] = skimage.data.stereo_motorcycle()[0]
    found |= {name: load_sample_image(f"{name}.jpg") for name in ("china", "flower")}
    hopper = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    decoded = cv2.imread(str(hopper))
    assert decoded is not None, hopper
    found["hopper"] = decoded[..., ::-1]
    return found


def main() -> None:
    """Write the photographs as PNG files."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, rgb in photographs().items():
        three = rgb if rgb.ndim == 3 else np.repeat(rgb[..., None], 3, axis=2)
        cv2.imwrite(str(folder / f"{name}.png"), np.ascontiguousarray(three[..., ::-1]))


if __name__ == "__main__":
    main()
