"""Points for all verified matches of a model whose poses are known."""

import tempfile
from pathlib import Path

import pycolmap

from jaxsfm.colmap.map_options import MapOptions, incremental_options
from jaxsfm.colmap.native import native

MIN_POINTS = 10
"""A model with fewer points is not refined."""


def with_all_points(
    model: pycolmap.Reconstruction, database: Path, options: MapOptions
) -> pycolmap.Reconstruction:
    """A copy of a model with the points of all verified matches of its images.

    COLMAP triangulates the points, joins them to tracks, adjusts them, and drops observations that
    are too far off. Poses and cameras stay.

    If COLMAP finds fewer than `MIN_POINTS`, the model keeps those that it has. This happens to
    models of two to four photos with a wrong camera: a model of *statue*, in which one of three
    photos had a focal length of a million pixels, came back without its 839 points. Then nothing
    could speak against it.

    Args:
      database: with the images and keypoints of the model.

    Raises:
      UserError: COLMAP failed.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        whole = native(
            lambda token: pycolmap.triangulate_points(
                pycolmap.Reconstruction(model),  # it is changed in place
                database,
                scratch,
                scratch,
                clear_points=True,
                options=incremental_options(options),
                refine_intrinsics=False,
                cancellation_token=token,
            ),
            database,
        )
    if whole.num_points3D() < min(MIN_POINTS, model.num_points3D()):
        return pycolmap.Reconstruction(model)
    return whole
