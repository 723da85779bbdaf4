"""COLMAP's two-view verification of the matches in a database."""

import dataclasses
from pathlib import Path

import cv2  # noqa: F401  before pycolmap: see jaxsfm.colmap.database
import pycolmap

from jaxsfm.colmap.native import native


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerificationOptions:
    """Settings of COLMAP's two-view verification."""

    seed: int = 0
    """For RANSAC."""
    threads: int = -1
    """-1 takes all cores."""
    scale: float = 1.0
    """Original pixels per working pixel. COLMAP's 4 px are multiplied by it."""
    relative_poses: bool = True
    """Also find the relative pose of every pair, which the view graph needs."""
    min_inliers: int | None = None
    """A pair with fewer inliers has none; None: COLMAP's 15."""

    def for_colmap(self) -> pycolmap.TwoViewGeometryOptions:
        """As COLMAP takes them."""
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = self.seed
        options.ransac.max_error *= self.scale
        options.compute_relative_pose = self.relative_poses
        if self.min_inliers is not None:
            options.min_num_inliers = self.min_inliers
        return options


def verify(path: Path, options: VerificationOptions) -> None:
    """Run COLMAP's own two-view verification on all pairs of a database (paper, section 4).

    Cameras with a known or prior focal length are verified as calibrated (essential matrices).

    Raises:
      UserError: COLMAP failed.
    """
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = options.threads
    native(
        lambda token: pycolmap.geometric_verification(
            path,
            verifier_options=verifier,
            two_view_geometry_options=options.for_colmap(),
            cancellation_token=token,
        ),
        path,
    )
