"""Writes COLMAP's dense workspace: photos without lens distortion, their model, and what to match.

COLMAP makes the workspace (controllers/undistorters.cc). Here its input is checked, because COLMAP
leaves a photo out that it cannot read, fills the missing part of a truncated one with black, and
raises no error in either case. A pinhole camera keeps its photo as it is, byte for byte.
"""

import shutil
from pathlib import Path

import pycolmap

from jaxsfm.colmap.formats.tables import registered_images
from jaxsfm.colmap.native import native
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import SPARE_BYTES, check_disk_space
from jaxsfm.io.images import inspect_image, read_image, shown_name

IMAGES, SPARSE = "images", "sparse"
READABLE = frozenset(".jpg .jpeg .jpe .png .tif .tiff .bmp .ppm .pgm".split())
"""The photos that the pip package of COLMAP 4.2 reads and writes (measured)."""
LONGEST_SIDE = 65_535
"""Pixels of a side of a camera without photos, which is that of the longest JPEG. COLMAP undistorts
every pixel of a camera's border: of so long a side, in 1 to 5 s."""
BYTES_PER_PIXEL = 3
"""More than a written photo takes: it is compressed, except for .bmp and .ppm."""


def write_undistorted(
    folder: Path, model_folder: Path, model: pycolmap.Reconstruction, photos: Path, max_size: int
) -> None:
    """Fill a folder with the images without distortion, `sparse` and `stereo`.

    `sparse` holds the model with pinhole cameras and undistorted keypoints, and `sparse/0` the same
    files, because programs for Gaussian splatting look for them there.

    Args:
      model_folder: the folder from which `model` was read.
      photos: the folder of the photos, as they are stored.
      max_size: the longest side of the new images, pixels; -1: any.

    Raises:
      UserError: a photo is missing, damaged, of another size than its camera, or in a format that
        COLMAP does not read; or COLMAP cannot undistort a camera.
    """
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_size
    images = registered_images(model)
    for image in images:
        _check_name(image.name)
        _check_photo(image.name, model.camera(image.camera_id), photos)
    used = {image.camera_id for image in images}
    for camera_id in set(model.cameras) - used:
        _check_size(model.camera(camera_id))
    cameras = {k: _undistorted(camera, options) for k, camera in model.cameras.items()}
    pixels = sum(
        cameras[image.camera_id].width * cameras[image.camera_id].height for image in images
    )
    check_disk_space(folder, SPARE_BYTES + BYTES_PER_PIXEL * pixels)
    native(
        lambda token: pycolmap.undistort_images(
            folder, model_folder, photos, undistort_options=options, cancellation_token=token
        ),
        model_folder,
    )
    for image in images:
        if not (folder / IMAGES / image.name).is_file():
            raise UserError(f"{shown_name(image.name)}: COLMAP could not undistort the photo")
    (folder / SPARSE / "0").mkdir()
    for file in sorted((folder / SPARSE).glob("*.bin")):
        shutil.copyfile(file, folder / SPARSE / "0" / file.name)


def _undistorted(
    camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions
) -> pycolmap.Camera:
    """The pinhole camera that COLMAP chooses; UserError if there is none."""
    try:
        return pycolmap.undistort_camera(options, camera)
    except ValueError as error:
        raise UserError(
            f"--to undistorted: COLMAP cannot undistort a camera of model {camera.model_name}"
        ) from error


def _check_size(camera: pycolmap.Camera) -> None:
    """Refuse a camera without photos that is so large that COLMAP would not end."""
    if max(camera.width, camera.height) > LONGEST_SIDE:
        raise UserError(
            f"--to undistorted: camera {camera.camera_id}, which has no photos, has {camera.width} "
            f"x {camera.height} pixels; at most {LONGEST_SIDE} a side are undistorted"
        )


def _check_name(name: str) -> None:
    """Refuse names that COLMAP's lists in `stereo` cut or leave out."""
    if name != name.strip() or not name.isprintable() or name.startswith("#"):
        raise UserError(
            f"--to undistorted: COLMAP's lists of photos cannot hold the name {shown_name(name)!r}"
        )


def _check_photo(name: str, camera: pycolmap.Camera, photos: Path) -> None:
    """Refuse a photo that is missing or damaged, and one that does not fit COLMAP or its camera."""
    path, shown = photos / name, shown_name(name)
    if not path.is_file():
        raise UserError(f"--images {photos}: no {shown} in it")
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise UserError(
            f"{shown}: COLMAP does not read {suffix or 'files without a suffix'}; undistorted "
            f"photos are made from {', '.join(sorted(READABLE))}"
        )
    file = inspect_image(path, name=name)
    if file.size != (camera.width, camera.height):
        raise UserError(
            f"{shown}: the photo has {file.size[0]} x {file.size[1]} pixels, but its camera "
            f"{camera.width} x {camera.height}; name the photos of the model with --images"
        )
    read_image(file, max_size=max(file.size))
