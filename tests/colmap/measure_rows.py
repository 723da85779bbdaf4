"""Costs and processor seconds of the whole model's adjustment beside Ceres, on rows of photos.

    OPENBLAS_NUM_THREADS=1 python tests/colmap/measure_rows.py 50 200 500

All photos of a row have one RADIAL camera, whose focal length starts 2 % off. They start 0.6 deg
and a sixth of a step off. The noise of keypoints is half a pixel, and the loss is Cauchy's.
"""

import dataclasses
import os
import sys
import time
from pathlib import Path

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import pycolmap
from long_rows import SIZE, STEP, off, row
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.bundle_adjustment import _by_colmap, adjusted
from jaxsfm.colmap.model import Model

HOW = {"loss_px": 1.0, "refine_intrinsics": True, "threads": 1, "steps": 100}


def start_of(truth: Model) -> Model:
    rng = np.random.default_rng(0)
    (k,) = truth.cameras.values()
    params = [1.02 * k.focal_length_x, k.principal_point_x, k.principal_point_y, 0.0, 0.0]
    width, height = SIZE
    camera = pycolmap.Camera(camera_id=1, model="RADIAL", width=width, height=height, params=params)
    views = []
    for view in truth.views:
        turn = np.radians(0.6) / np.sqrt(3) * rng.normal(size=3)
        rotation = Rotation.from_rotvec(turn).as_matrix() @ view.rotation
        centre = view.centre + STEP / 6 / np.sqrt(3) * rng.normal(size=3)
        views.append(dataclasses.replace(view, camera=camera, rotation=rotation, centre=centre))
    points = truth.tracks.points + 0.05 * rng.normal(size=truth.tracks.points.shape)
    return Model(views, truth.tracks._replace(points=points), {1: camera})


def cost_of(model: Model) -> float:
    errors = model.errors_px()
    return float(np.log1p(errors[np.isfinite(errors)] ** 2).sum() / 2)


def main() -> None:
    for count in map(int, sys.argv[1:]):
        truth = row(count, per_photo=222, noise_px=0.5)
        start = start_of(truth)
        print(f"{count} photos, {len(start.tracks.point)} observations")
        adjusted(start, **HOW)  # compiles
        ceres, begin = start.to_colmap(), time.process_time()
        _by_colmap(ceres, **HOW)
        middle = time.process_time()
        ours = adjusted(start, **HOW)
        end = time.process_time()
        theirs = Model.from_colmap(ceres, truth.sizes)
        for name, found, spent in (("Ceres", theirs, middle - begin), ("ours", ours, end - middle)):
            print(
                f"  {name}: cost {cost_of(found):.3f}, {spent:.1f} s, {off(found, truth):.3f} off"
            )


if __name__ == "__main__":
    main()
