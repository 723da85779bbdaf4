"""Processor seconds of the core's bundle adjustment beside Ceres, on a row of photos.

    OPENBLAS_NUM_THREADS=1 python tests/colmap/measure_bundle.py [--iterative]

The size is that of Ladybug-49 of "Bundle adjustment in the large": 49 photos, 7,776 points and
31,843 observations. Each photo has a RADIAL camera of its own, with a free focal length and two
free coefficients.
"""

import os
import sys
import time

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from jaxsfm.core.bundle import adjust, frame_held
from jaxsfm.core.bundle_layout import Free, layout_of
from jaxsfm.core.bundle_problem import Observations, Poses, Scene
from jaxsfm.core.cameras import intrinsics_of

PHOTOS, POINTS, ROWS = 49, 7776, 31843


def row_of_photos():
    """A start that is some pixels off, and the rows. Keypoints have a noise of half a pixel."""
    rng = np.random.default_rng(0)
    drawn = rng.exponential(size=POINTS)
    length = 2 + np.floor(drawn / drawn.sum() * (ROWS - 2 * POINTS)).astype(int)
    length[rng.permutation(POINTS)[: ROWS - length.sum()]] += 1
    first = rng.integers(0, PHOTOS - length + 1)
    point = np.repeat(np.arange(POINTS), length)
    photo = np.arange(ROWS) - np.repeat(np.cumsum(length) - length, length) + first[point]
    at, depth = np.arange(PHOTOS), rng.uniform(3, 15, POINTS)
    centres = np.column_stack([0.3 * at, 0.2 * np.sin(0.3 * at), 0.1 * rng.normal(size=PHOTOS)])
    turns = Rotation.from_rotvec(0.05 * rng.normal(size=(PHOTOS, 3)))
    shifts = -turns.apply(centres)
    aside = depth[:, None] * rng.uniform(-0.4, 0.4, (POINTS, 2))
    points = np.column_stack([aside + [[0.3, 0]] * (first + length / 2)[:, None], depth])
    params = [[500.0, 320.0, 240.0, *k] for k in rng.normal([-0.1, 0.02], [0.01, 0.005], (49, 2))]
    rays = turns[photo].apply(points[point]) + shifts[photo]
    xy = 0.5 * rng.normal(size=(ROWS, 2))
    for k, own in enumerate(params):
        camera = pycolmap.Camera(model="RADIAL", width=640, height=480, params=own)
        xy[photo == k] += camera.img_from_cam(rays[photo == k])
    turns = Rotation.from_rotvec(0.01 * rng.normal(size=(PHOTOS, 3))) * turns
    poses = Poses(turns.as_matrix(), shifts + 0.05 * rng.normal(size=shifts.shape))
    points += 0.1 * rng.normal(size=points.shape)
    return poses, points, [[510.0, 320.0, 240.0, 0.0, 0.0]] * PHOTOS, photo, point, xy


def ceres(poses, points, params, photo, point, xy) -> str:
    """The same by COLMAP's default adjuster without a robust loss."""
    model, place = pycolmap.Reconstruction(), np.zeros(ROWS, int)
    for k, own in enumerate(params):
        camera = pycolmap.Camera(camera_id=k + 1, model="RADIAL", width=640, height=480, params=own)
        model.add_camera_with_trivial_rig(camera)
        place[photo == k] = np.arange(np.sum(photo == k))
        image = pycolmap.Image(
            name=str(k), camera_id=k + 1, image_id=k + 1, keypoints=xy[photo == k]
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(poses.rotations[k]), poses.translations[k])
        model.add_image_with_trivial_frame(image, pose)
    tracks = [pycolmap.Track() for _ in points]
    for one, own, at in zip(photo.tolist(), point.tolist(), place.tolist(), strict=True):
        tracks[own].add_element(one + 1, at)
    for x, track in zip(points, tracks, strict=True):
        model.add_point3D(x, track, np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads, solver.function_tolerance = 1, 1e-7
    solver.gradient_tolerance = solver.parameter_tolerance = 0
    config = pycolmap.BundleAdjustmentConfig()
    for k in model.reg_image_ids():
        config.add_image(k)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    before = time.process_time()
    report = adjuster.solve().ceres_summary.BriefReport()
    return f"{time.process_time() - before:.2f} s; {report}"


def main() -> None:
    poses, points, params, photo, point, xy = given = row_of_photos()
    print("Ceres:", ceres(*given))
    wide, model = intrinsics_of(["RADIAL"] * PHOTOS, params)
    with jax.enable_x64(True):
        free = Free(
            np.asarray(frame_held(jax.tree.map(jax.numpy.asarray, poses))),
            np.ones(POINTS, bool),
            np.isin(np.arange(8), [0, 3, 4]) & np.ones((PHOTOS, 1), bool),
        )
        dense = "--iterative" not in sys.argv
        layout = layout_of(photo, point, free, camera=np.arange(PHOTOS), model=model, dense=dense)
        start = Scene(poses, np.column_stack([points, np.ones(POINTS)]), wide)
        seen = Observations(xy, np.ones(ROWS))

        def loss(*x):
            found = adjust(*x)
            return found.scene.poses.translations.sum(), found

        programs = {
            "adjust": lambda *x: adjust(*x, tolerance=1e-7),
            "adjust and gradient": jax.value_and_grad(loss, 1, has_aux=True),
        }
        for name, program in programs.items():
            before = time.process_time()
            compiled = jax.jit(program).lower(start, seen, layout).compile()
            compiling = time.process_time() - before
            jax.block_until_ready(compiled(start, seen, layout))
            before = time.process_time()
            found = jax.block_until_ready(compiled(start, seen, layout))
            spent = time.process_time() - before
            found = found if name == "adjust" else found[0][1]
            memory = compiled.memory_analysis().temp_size_in_bytes / 2**20
            print(
                f"{name}: {spent:.2f} s after {compiling:.0f} s of compiling, {memory:.0f} MiB; "
                f"{found.steps} steps, cost {found.cost:.6e}, converged {found.converged}"
            )


if __name__ == "__main__":
    main()
