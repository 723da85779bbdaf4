"""COLMAP's own features as the baseline: RootSIFT, exhaustive matching, the same verification."""

from pathlib import Path

import cv2  # noqa: F401  before pycolmap: see jaxsfm.host.colmap
import pycolmap

from jaxsfm.host.images import ImageFile
from jaxsfm.host.intrinsics import Intrinsics
from jaxsfm.host.native import native


def write_rootsift_database(
    path: Path,
    folder: Path,
    images: list[ImageFile],
    intrinsics: Intrinsics | None,
    *,
    seed: int,
    threads: int,
) -> None:
    """A new database with COLMAP's DoG + RootSIFT features, matched and verified.

    COLMAP's defaults throughout; one camera for all images if intrinsics are given, else one per
    image from EXIF or 1.2 x the longer side.

    Args:
      folder: the images' folder.
    """
    path.unlink(missing_ok=True)
    reader = pycolmap.ImageReaderOptions()
    mode = pycolmap.CameraMode.PER_IMAGE
    if intrinsics is not None:
        reader.camera_model = intrinsics.model
        reader.camera_params = ",".join(repr(float(p)) for p in intrinsics.params)
        mode = pycolmap.CameraMode.SINGLE
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.use_gpu = False
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    two_view = pycolmap.TwoViewGeometryOptions()
    two_view.ransac.random_seed = seed
    two_view.compute_relative_pose = True

    def work(_: pycolmap.CancellationToken) -> None:
        pycolmap.extract_features(
            path,
            folder,
            image_names=[image.name for image in images],
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
        )
        pycolmap.match_exhaustive(path, matching_options=matching, verification_options=two_view)

    native(work, path, grace_s=1)
