"""Verification and mapping of a database, as the pipeline strings them together."""

from collections.abc import Callable
from pathlib import Path

import pycolmap

from jaxsfm.colmap.mapper import MapOptions, build_models
from jaxsfm.colmap.two_views import read_two_views
from jaxsfm.colmap.verification import VerificationOptions, verify


def verified(path: Path, options: MapOptions):
    """The pairs of a database after COLMAP's verification."""
    verify(
        path,
        VerificationOptions(seed=options.seed, threads=options.threads, scale=options.scale),
    )
    return read_two_views(path)


def map_database(
    path: Path, options: MapOptions, *, on_image: Callable[[], None] = lambda: None
) -> list[pycolmap.Reconstruction]:
    """Its models, the largest first."""
    return build_models(path, verified(path, options), options, on_image=on_image)[0]
