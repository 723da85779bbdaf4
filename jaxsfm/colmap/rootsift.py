"""COLMAP's own features as the baseline: RootSIFT, exhaustive matching, the same verification."""

import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2  # noqa: F401  before pycolmap: see jaxsfm.colmap.database
import pycolmap

from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.native import native
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair


def write_rootsift_database(
    path: Path,
    folder: Path,
    images: list[ImageFile],
    intrinsics: Intrinsics | None,
    *,
    seed: int,
    threads: int,
    min_inliers: int | None = None,
    pairs: Iterable[Pair] | None = None,
) -> None:
    """A new database with COLMAP's DoG + RootSIFT features, matched and verified.

    COLMAP's defaults throughout; one camera for all images if intrinsics are given, else one per
    image from EXIF or 1.2 x the longer side.

    Args:
      folder: the images' folder.
      pairs: the ones matched; None: all.
      min_inliers: pairs with fewer matches or inliers are emptied; None: COLMAP's 15.

    Raises:
      UserError: an image that COLMAP leaves out (a format it does not read, or, with given
        intrinsics, another size).
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
    if min_inliers is not None:
        two_view.min_num_inliers = min_inliers

    def work(_: pycolmap.CancellationToken) -> None:
        pycolmap.extract_features(
            path,
            folder,
            image_names=[image.name for image in images],
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
        )
        options = {"matching_options": matching, "verification_options": two_view}
        if pairs is None:
            pycolmap.match_exhaustive(path, **options)
            return
        chosen = pycolmap.ImportedPairingOptions()
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            chosen.match_list_path = Path(scratch) / "pairs.txt"
            text = "".join(f"{a} {b}\n" for a, b in pairs)
            Path(chosen.match_list_path).write_text(text, encoding="utf-8")
            pycolmap.match_image_pairs(path, pairing_options=chosen, **options)

    native(work, path, grace_s=1)
    with pycolmap.Database.open(path) as db:
        there = {image.name for image in db.read_all_images()}
    if lost := sorted({image.name for image in images} - there):
        raise UserError(f"{folder / lost[0]}: COLMAP cannot read this image, so not for RootSIFT")
