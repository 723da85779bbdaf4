"""COLMAP's own features as the baseline: RootSIFT, exhaustive matching, the same verification."""

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import pycolmap

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import changed, opened
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
    cameras: Cameras,
    verification: VerificationOptions,
    *,
    pairs: Iterable[Pair] | None = None,
    max_size: int | None = None,
) -> None:
    """Write a new database with COLMAP's DoG + RootSIFT features, matched and verified.

    COLMAP's defaults are used throughout.

    Args:
      cameras: which images share a camera, and what is known of it. If it is not one camera of all
        images, each has its own.
      verification: its threads are those of extraction and matching too. Pairs with fewer matches
        or inliers than its `min_inliers` are emptied.
      pairs: those to match; None: all.
      max_size: larger photos are reduced to this longer side, in pixels, before features are found;
        None: COLMAP's own limit.

    Raises:
      UserError: COLMAP leaves an image out, because it does not read the format or, with given
        intrinsics, because of another size.
    """
    path.unlink(missing_ok=True)
    reader, known = pycolmap.ImageReaderOptions(), cameras.known
    reader.camera_model = cameras.model
    alone = len(cameras.groups(images)) == 1
    mode = pycolmap.CameraMode.SINGLE if alone else pycolmap.CameraMode.PER_IMAGE
    if isinstance(known, Intrinsics):
        reader.camera_model = known.model
        reader.camera_params = ",".join(repr(float(p)) for p in known.params)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = verification.threads
    extraction.use_gpu = False
    if max_size is not None:
        extraction.max_image_size = max_size
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
        if isinstance(known, Mapping):
            _set_cameras(path, images, known)
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
    with opened(path) as db:
        there = {image.name for image in db.read_all_images()}
    if lost := sorted({image.name for image in images} - there):
        raise UserError(f"{folder / lost[0]}: COLMAP cannot read this image, which RootSIFT needs")


def _set_cameras(path: Path, images: list[ImageFile], known: Mapping[str, Intrinsics]) -> None:
    """Replace the guessed cameras of a database by known ones."""
    sizes = {image.name: image.size for image in images}
    with changed(path) as db:
        for image in db.read_all_images():
            camera = known[image.name].camera(sizes[image.name])
            camera.camera_id = image.camera_id
            db.update_camera(camera)
