"""Which photos share a camera, and what is known of a camera before the mapping.

The intrinsics of a shared camera are estimated from all of its photos together. That is more
accurate than a camera for each photo, if the photos were in fact taken with one camera.

COLMAP guesses a focal length from EXIF and from its list of sensor widths. It needs the size of the
photo and a few EXIF tags but not the pixels. COLMAP 4.2 reads neither HEIC nor camera RAW: of such
photos it gets a file that stands in for theirs.
"""

import contextlib
import dataclasses
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import pycolmap
from PIL import ExifTags, Image

from jaxsfm.colmap.intrinsics import (
    MODELS,
    Intrinsics,
    KnownCameras,
    camera_of,
    check_fits,
    check_one_size,
    is_turned,
    sizes_of,
)
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.decoders import BRANDS_END, open_header, special_format
from jaxsfm.io.images import ImageFile, image_bytes, shown_name
from jaxsfm.io.orientation import QUARTERS
from jaxsfm.options import CameraSharing

GUESSED_FOCAL = 1.2
"""COLMAP's guess of an unknown focal length, in units of the longer side of the photo."""
Tag = ExifTags.Base
CAMERA = (Tag.Make, Tag.Model)
LENS = (
    Tag.FocalLength,
    Tag.FocalLengthIn35mmFilm,
    Tag.FocalPlaneXResolution,
    Tag.FocalPlaneYResolution,
    Tag.FocalPlaneResolutionUnit,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cameras:
    """What is known and assumed of the cameras of photos."""

    known: KnownCameras | None = None
    """The known cameras. With them, the other fields have no effect."""
    sharing: CameraSharing = "auto"
    model: str = "SIMPLE_RADIAL"
    """COLMAP's model of a camera that is not known."""

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"model must be one of {sorted(MODELS)}; got {self.model!r}")

    def check_fits(self, images: Iterable[ImageFile]) -> None:
        """Raise UserError if the known cameras or the sharing do not fit the photos."""
        if self.known is not None:
            check_fits(self.known, sizes_of(self.known, images))
        elif self.sharing == "single":
            sizes = {image.name: image.size for image in images}
            check_one_size(sizes, "--cameras single: there is")

    def plain(self) -> Json:
        """The same as JSON, which tells different cameras apart."""
        known = self.known
        if isinstance(known, Mapping):
            return {name: dataclasses.asdict(each) for name, each in known.items()}
        return dataclasses.asdict(known) if known else [self.sharing, self.model]

    def assigned(
        self, images: Sequence[ImageFile]
    ) -> list[tuple[pycolmap.Camera, list[ImageFile]]]:
        """The cameras, each with its photos (`groups`).

        Raises:
          UserError: a known camera does not fit its photos, or COLMAP does not accept it.
        """
        upright = pixels_were_turned(images)
        return [(self._camera(group, upright), group) for group in self.groups(images)]

    def groups(self, images: Sequence[ImageFile]) -> list[list[ImageFile]]:
        """The photos that share a camera: groups and photos in the order of the photos' names."""
        ordered = sorted(images, key=lambda image: image.name)
        one_source, upright = _from_one_source(ordered), pixels_were_turned(ordered)
        together: dict[object, list[ImageFile]] = {}
        for image in ordered:
            key = self._key(image, one_source), image.orientation if upright else None
            together.setdefault(key, []).append(image)
        return list(together.values())

    def _key(self, image: ImageFile, one_source: bool) -> object:
        """Photos with equal keys share a camera, unless their pixels were turned differently."""
        if isinstance(self.known, Intrinsics):
            return image.size, image.orientation if is_turned(self.known, image) else None
        if self.known is not None:
            return self.known[image.name], image.size
        match self.sharing:
            case "single":
                return image.size
            case "folder":
                return PurePosixPath(image.name).parent, image.size
            case "photo":
                return image.name
            case "auto":
                told = image.taken_with or one_source
                return (image.taken_with, image.size) if told else image.name

    def _camera(self, group: Sequence[ImageFile], upright: bool) -> pycolmap.Camera:
        """The camera of photos that share it: from EXIF if one of them has a focal length."""
        if self.known is not None:
            known = camera_of(self.known, group[0], upright=upright)
            return accepted(known.camera(group[0].size), group[0])
        return estimated_camera(group, self.model)


def pixels_were_turned(images: Sequence[ImageFile]) -> bool:
    """Whether a program has turned the pixels of some photos of one camera, and noted it.

    A camera stores the rows of its sensor, however it is held. Then all photos have one size as
    they are stored, and a known camera is that of the stored pixels. If they have one size only
    when they are upright, it is that of the upright photos.
    """
    stored, upright = {i.size for i in images}, {i.upright_size for i in images}
    codes = {image.orientation for image in images}
    return len(upright) == 1 < len(stored) and codes <= set(QUARTERS)


def _from_one_source(images: Sequence[ImageFile]) -> bool:
    """Whether photos without EXIF seem to come from one camera, such as the frames of a video.

    They have one size, up to quarter turns, and the EXIF data of no photo names a camera. In a
    collection of a photo site some photos have EXIF, and those that have lost it are of any camera.
    """
    sizes = {tuple(sorted(image.size)) for image in images}
    return len(sizes) == 1 and not any(image.taken_with for image in images)


def estimated_camera(group: Sequence[ImageFile], model: str = "SIMPLE_RADIAL") -> pycolmap.Camera:
    """The camera that photos of one size start with, before it is refined.

    The focal length comes from the EXIF data of the first photo that has one. COLMAP knows the
    sensors of many cameras. Without EXIF it is `GUESSED_FOCAL` x the longer side of the photo.

    Raises:
      UserError: COLMAP does not accept the camera.
    """
    # A photo that is not the first is asked only if EXIF says that the camera is the same.
    size = group[0].size
    options = pycolmap.ImageReaderOptions()
    options.camera_model = model
    for image in group if group[0].taken_with else group[:1]:
        try:
            with readable_by_colmap(image) as path:
                camera = pycolmap.infer_camera_from_image(path, options)
        except Exception:  # COLMAP reads fewer formats, and raises various errors
            continue
        if camera.has_prior_focal_length and (camera.width, camera.height) == size:
            break
    else:
        camera = pycolmap.Camera.create_from_model_name(0, model, GUESSED_FOCAL * max(size), *size)
    return accepted(camera, group[0])


def accepted(camera: pycolmap.Camera, image: ImageFile) -> pycolmap.Camera:
    """The camera; UserError, which names the photo, if COLMAP does not accept it."""
    if not camera.verify_params():
        raise UserError(
            f"{shown_name(image.name)}: COLMAP does not accept the camera {camera.model_name} "
            f"{camera.params}"
        )
    return camera


@contextlib.contextmanager
def readable_by_colmap(image: ImageFile) -> Iterator[Path]:
    """The file of a photo, or a grey JPEG with its size and its camera's EXIF tags.

    Raises OSError or ImageError if the file has changed or cannot be read.
    """
    with image.path.open("rb") as file:
        if special_format(file.read(BRANDS_END), image.path.suffix) is None:
            yield image.path
            return
    data = image_bytes(image)
    with open_header(data, image.path.suffix) as header:
        exif = _of_camera(header.getexif())
    width, height = image.size
    _, grey = cv2.imencode(".jpg", np.zeros((height, width), np.uint8))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        path = Path(scratch) / "camera.jpg"
        path.write_bytes(_with_exif(grey.tobytes(), exif))
        yield path


def _of_camera(exif: Image.Exif) -> Image.Exif:
    """The tags that say what the camera and its lens are."""
    kept = Image.Exif()
    for tag in CAMERA:
        if tag in exif:
            kept[tag] = exif[tag]
    lens = exif.get_ifd(ExifTags.IFD.Exif)
    kept.get_ifd(ExifTags.IFD.Exif).update({tag: lens[tag] for tag in LENS if tag in lens})
    return kept


def _with_exif(jpeg: bytes, exif: Image.Exif) -> bytes:
    """A JPEG with EXIF data: its segment APP1 follows the start marker (ITU-T T.81, B.1)."""
    content = exif.tobytes()
    return jpeg[:2] + b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content + jpeg[2:]
