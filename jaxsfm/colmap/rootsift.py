"""COLMAP's own features as the baseline: RootSIFT, exhaustive matching, the same verification."""

import tempfile
from collections.abc import Iterable
from pathlib import Path

import pycolmap

from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.native import native
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair


def write_rootsift_database(
    path: Path,
    folder: Path,
    images: list[ImageFile],
    intrinsics: Intrinsics | None,
    verification: VerificationOptions,
    *,
    pairs: Iterable[Pair] | None = None,
) -> None:
    """Write a new database with COLMAP's DoG + RootSIFT features, matched and verified.

    COLMAP's defaults are used throughout. If intrinsics are given, there is one camera for all
    images; otherwise one per image, from EXIF or with 1.2 x the longer side as focal length.

    Args:
      verification: its threads are those of extraction and matching too. Pairs with fewer matches
        or inliers than its `min_inliers` are emptied.
      pairs: those to match; None: all.

    Raises:
      UserError: COLMAP leaves an image out, because it does not read the format or, with given
        intrinsics, because of another size.
    """
    path.unlink(missing_ok=True)
    reader = pycolmap.ImageReaderOptions()
    mode = pycolmap.CameraMode.PER_IMAGE
    if intrinsics is not None:
        reader.camera_model = intrinsics.model
        reader.camera_params = ",".join(repr(float(p)) for p in intrinsics.params)
        mode = pycolmap.CameraMode.SINGLE
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = verification.threads
    extraction.use_gpu = False
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = verification.threads
    matching.use_gpu = False
    two_view = verification.for_colmap()

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
        raise UserError(f"{folder / lost[0]}: COLMAP cannot read this image, which RootSIFT needs")
