"""Verify and map a database as a run does."""

from collections.abc import Callable
from pathlib import Path

import pycolmap

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import run_mapper
from jaxsfm.colmap.two_views import read_two_views, verify


def verified(path: Path, options: MapOptions):
    """Verify a database; returns its verified pairs."""
    verify(
        path,
        options.verification(),
    )
    return read_two_views(path)


def map_database(
    path: Path, options: MapOptions, *, on_image: Callable[[], None] = lambda: None
) -> list[pycolmap.Reconstruction]:
    """Verify and map a database; returns its models, the largest first."""
    verified(path, options)
    return run_mapper(path, options, on_image=on_image)
