"""The core's bundle adjustment ends where COLMAP's does, which is Ceres'."""

import jax
import numpy as np
from room_scene import arrays, exact_tracks

from jaxsfm.colmap.bundle_adjustment import _by_colmap
from jaxsfm.colmap.model import Model
from jaxsfm.core.bundle import adjust, frame_held
from jaxsfm.core.bundle_layout import Free, layout_of
from jaxsfm.core.bundle_problem import Observations, Poses, Scene
from jaxsfm.core.cameras import intrinsics_of


def poses_of(model: Model) -> Poses:
    rotations = np.stack([view.rotation for view in model.views])
    centres = np.stack([view.centre for view in model.views])
    return Poses(rotations, -np.einsum("cij,cj->ci", rotations, centres))


def test_the_cost_of_a_rendered_room_is_that_of_ceres(rendered):
    """Five views share one camera, whose parameters are adjusted; noise of a pixel."""
    tracks, rng = exact_tracks(rendered), np.random.default_rng(1)
    tracks = tracks._replace(xy=tracks.xy + rng.normal(size=tracks.xy.shape))
    ceres = Model(rendered.views, tracks).to_colmap()
    start = arrays(ceres, rendered)
    _by_colmap(ceres, loss_px=2.0, refine_intrinsics=True, threads=1, steps=50)
    squared = arrays(ceres, rendered).errors_px() ** 2
    expected = 2.0 * np.sum(np.log1p(squared / 4.0))  # half of 4 log(1 + s / 4)

    camera = start.views[0].camera
    params, model = intrinsics_of([camera.model_name], [list(camera.params)])
    params[:, 2:4] -= 0.5  # in pixels whose centres are at whole numbers
    count = len(start.tracks.points)
    points = np.column_stack([start.tracks.points, np.ones(count)])
    xy = np.asarray(start.tracks.xy)
    with jax.enable_x64(True):
        held = np.asarray(jax.jit(frame_held)(poses_of(start)))
        free = Free(held, np.ones(count, bool), np.arange(8)[None] < 4)
        rows = start.tracks.view, start.tracks.point
        layout = layout_of(*rows, free, camera=np.zeros(5, int), model=model)
        program = jax.jit(lambda *given: adjust(*given, scale=2.0, tolerance=1e-10))
        scene = Scene(poses_of(start), points, params)
        found = program(scene, Observations(xy, np.ones(len(xy))), layout)
    assert found.converged and len(xy) == len(squared) > 2000
    np.testing.assert_allclose(found.cost, expected, rtol=1e-6)
