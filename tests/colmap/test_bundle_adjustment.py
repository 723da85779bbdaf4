"""Laws of COLMAP's bundle adjustment as it is used here."""

import numpy as np
from room_scene import Room, arrays, exact_model

from jaxsfm.colmap.bundle_adjustment import bundle_adjust


def diverging(room: Room, points: int):
    """The exact room, in which the rays of some points' only two observations meet behind the
    cameras. COLMAP has the points in front."""
    model = exact_model(room)
    tracks = model.tracks
    both = np.flatnonzero((room.visible[:, 0]) & (room.visible[:, 4]))[:points]
    drop = np.isin(tracks.point, both) & ~np.isin(tracks.view, [0, 4])
    xy = tracks.xy.copy()
    for point in both:
        for view, other in ((0, 4), (4, 0)):
            row = np.flatnonzero((tracks.point == point) & (tracks.view == view))[0]
            ray = model.views[other].centre - model.views[view].centre
            towards, _ = model.views[view].project((tracks.points[point] + 0.3 * ray)[None])
            xy[row] += 3 * (towards[0] - xy[row])  # past the parallel, to the other side
    return model.with_tracks(tracks._replace(xy=xy)).select(~drop).to_colmap()


def test_points_that_end_behind_a_camera_are_left_out(rendered):
    """COLMAP gives such a point an error of 1e154, and our reader refuses a model with it."""
    model = diverging(rendered, 5)
    before = model.num_points3D()
    bundle_adjust(model, loss_px=1000.0, refine_intrinsics=False, threads=1)
    assert before - 5 <= model.num_points3D() < before
    assert max(point.error for point in model.points3D.values()) < 1e3
    assert np.isfinite(arrays(model, rendered).errors_px()).all()


def test_an_exact_model_stays_as_it_is(rendered):
    model = exact_model(rendered).to_colmap()
    before = arrays(model, rendered)
    bundle_adjust(model, loss_px=1.0, refine_intrinsics=False, threads=1)
    after = arrays(model, rendered)
    np.testing.assert_allclose(after.tracks.points, before.tracks.points, atol=1e-6)
    assert after.errors_px().max() < 1e-4
