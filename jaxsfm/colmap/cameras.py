"""Which photos share a camera, and what is known of a camera before the mapping.

The intrinsics of a shared camera are estimated from all of its photos together. That is more
accurate than a camera for each photo, if the photos were in fact taken with one camera.

COLMAP guesses a focal length from EXIF and from its list of sensor widths. It needs the size of the
photo and a few EXIF tags but not the pixels. COLMAP 4.2 reads neither HEIC nor camera RAW: of such
photos it gets a file that stands in for theirs.
"""

import contextlib
import dataclasses
import logging
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import pycolmap
from PIL import Image

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
from jaxsfm.io.decoders import BRANDS_END, special_format
from jaxsfm.io.exif_camera import ExifCamera, exif_camera, is_of_a_lens
from jaxsfm.io.exif_data import exif_data
from jaxsfm.io.images import ImageFile, named, shown_name
from jaxsfm.io.orientation import QUARTERS
from jaxsfm.io.rig_config import Rig, check_rigs, rig_photos
from jaxsfm.options import CameraSharing

logger = logging.getLogger("jaxsfm")

GUESSED_FOCAL = 1.2
"""COLMAP's guess of an unknown focal length, in units of the longer side of the photo."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cameras:
    """What is known and assumed of the cameras of photos."""

    known: KnownCameras | None = None
    """The known cameras. With them, the other fields have no effect."""
    sharing: CameraSharing = "auto"
    model: str = "SIMPLE_RADIAL"
    """COLMAP's model of a camera that is not known."""
    rigs: tuple[Rig, ...] = ()
    """What cameras are mounted together. Each camera of a rig is one of its own, and may say its
    intrinsics."""

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"model must be one of {sorted(MODELS)}; got {self.model!r}")

    def check_fits(self, images: Iterable[ImageFile]) -> None:
        """Raise UserError if the known cameras, the sharing or the rigs do not fit the photos."""
        images = list(images)
        check_rigs(self.rigs, {image.name: image.size for image in images})
        if self.known is not None:
            check_fits(self.known, sizes_of(self.known, images))
        elif self.sharing == "single":
            sizes = {image.name: image.size for image in images}
            check_one_size(sizes, "--cameras single: there is")

    def plain(self) -> Json:
        """The same as JSON, which tells different cameras apart."""
        known = self.known
        if isinstance(known, Mapping):
            found: Json = {name: dataclasses.asdict(each) for name, each in known.items()}
        else:
            found = dataclasses.asdict(known) if known else [self.sharing, self.model]
        return [found, [rig.plain() for rig in self.rigs]] if self.rigs else found

    def assigned(
        self, images: Sequence[ImageFile]
    ) -> list[tuple[pycolmap.Camera, list[ImageFile]]]:
        """The cameras, each with its photos (`groups`).

        Raises:
          UserError: a known camera does not fit its photos, or COLMAP does not accept it.
        """
        groups = self.groups(images)
        if self.known is None:  # from EXIF if one of the photos has a focal length
            told = [self._told(group) for group in groups]
            report_doubts(doubts for _, doubts in told)
            return [(camera, group) for (camera, _), group in zip(told, groups, strict=True)]
        upright, given = pixels_were_turned(images), []
        for group in groups:
            known = camera_of(self.known, group[0], upright=upright)
            given.append((accepted(known.camera(group[0].size), group[0]), group))
        return given

    def _told(self, group: Sequence[ImageFile]) -> tuple[pycolmap.Camera, dict[str, list[str]]]:
        """The camera of photos as their rig says, or as `told_camera` does."""
        known = rig_intrinsics(self.rigs, group[:1])
        if not known:
            return told_camera(group, self.model)
        return accepted(known[group[0].name].camera(group[0].size), group[0]), {}

    def held(self, images: Sequence[ImageFile]) -> tuple[int, ...]:
        """The ids, in a new database, of the cameras whose place on their rig is known."""
        mounted = rig_photos(self.rigs, (image.name for image in images))
        places = [mounted.get(group[0].name) for group in self.groups(images)] if mounted else []
        return tuple(
            number
            for number, place in enumerate(places, 1)
            if place is not None
            and place.camera != self.rigs[place.rig].reference
            and self.rigs[place.rig].cameras[place.camera].known
        )

    def groups(self, images: Sequence[ImageFile]) -> list[list[ImageFile]]:
        """The photos that share a camera: groups and photos in the order of the photos' names."""
        ordered = sorted(images, key=lambda image: image.name)
        one_source, upright = _from_one_source(ordered), pixels_were_turned(ordered)
        mounted = rig_photos(self.rigs, (image.name for image in ordered))
        together: dict[object, list[ImageFile]] = {}
        for image in ordered:
            if image.name in mounted:
                key = mounted[image.name][:2]
            else:
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


def rig_intrinsics(rigs: Sequence[Rig], images: Sequence[ImageFile]) -> dict[str, Intrinsics]:
    """The intrinsics of photos whose rig says those of its camera, by name.

    Raises:
      UserError: the camera is none of COLMAP's, or not one of such photos.
    """
    sizes, found = {image.name: image.size for image in images}, dict[str, Intrinsics]()
    for name, photo in rig_photos(rigs, sizes).items():
        camera = rigs[photo.rig].cameras[photo.camera]
        if camera.model is None:
            continue
        where = f"--rig: the camera {shown_name(camera.prefix)}"
        if camera.model not in MODELS:
            raise UserError(f"{where}: camera_model_name must be one of {', '.join(MODELS)}")
        width, height = sizes[name]
        usual = pycolmap.Camera.create_from_model_name(0, camera.model, 1.0, width, height)
        if len(camera.params) != len(usual.params):
            raise UserError(
                f"{where}: camera_params must be {len(usual.params)} numbers "
                f"({usual.params_info}); got {len(camera.params)}"
            )
        found[name] = Intrinsics(model=camera.model, params=camera.params)
        given = found[name].camera((width, height))
        cx, cy = given.principal_point_x, given.principal_point_y
        if not (0 < cx < width and 0 < cy < height) or given.mean_focal_length() <= 0:
            raise UserError(
                f"{where}: camera_params are not those of photos of {width} x {height} pixels"
            )
    return found


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
    """The camera that photos of one size start with, before it is refined (`told_camera`).

    Tags of EXIF that cannot be are named in one line of the log.

    Raises:
      UserError: COLMAP does not accept the camera.
    """
    camera, doubts = told_camera(group, model)
    report_doubts([doubts])
    return camera


def told_camera(
    group: Sequence[ImageFile], model: str
) -> tuple[pycolmap.Camera, dict[str, list[str]]]:
    """The camera that photos of one size start with, and which tags of EXIF are not believed.

    The focal length comes from the EXIF data of the first photo that has one. COLMAP knows the
    sensors of many cameras. Without EXIF it is `GUESSED_FOCAL` x the longer side of the photo.

    Returns:
      the camera; the names of photos, by what is wrong with their EXIF data.

    Raises:
      UserError: COLMAP does not accept the camera.
    """
    # A photo that is not the first is asked only if EXIF says that the camera is the same.
    size, doubts = group[0].size, dict[str, list[str]]()
    for image in group if group[0].taken_with else group[:1]:
        camera, doubt = _from_exif(image, model)
        if doubt is not None:
            doubts.setdefault(doubt, []).append(image.name)
        if camera is not None and (camera.width, camera.height) == size:
            break
    else:
        camera = pycolmap.Camera.create_from_model_name(0, model, GUESSED_FOCAL * max(size), *size)
    return accepted(camera, group[0]), doubts


def report_doubts(each: Iterable[Mapping[str, Sequence[str]]]) -> None:
    """Name each kind of tags that are not believed once, with its photos.

    Args:
      each: of each camera, the names of photos by what is wrong with their EXIF data.
    """
    together: dict[str, list[str]] = {}
    for doubts in each:
        for doubt, names in doubts.items():
            together.setdefault(doubt, []).extend(names)
    for doubt, names in together.items():
        logger.warning("%s: EXIF is not believed about %s", named(sorted(names)), doubt)


def _from_exif(image: ImageFile, model: str) -> tuple[pycolmap.Camera | None, str | None]:
    """The camera of a photo if EXIF gives a focal length that can be, and what is not believed."""
    options = pycolmap.ImageReaderOptions()
    options.camera_model = model
    try:
        told = exif_camera(exif_data(image).tags, image.size)
        if told.doubt is not None and not told.lens:
            return None, f"{told.doubt}, so the focal length is guessed"
        with readable_by_colmap(image, told) as path:
            camera = pycolmap.infer_camera_from_image(path, options)
    except Exception:  # COLMAP reads fewer formats, and raises various errors
        return None, None
    doubt = told.doubt and f"{told.doubt}, so it is not used"
    if not camera.has_prior_focal_length:
        return None, doubt
    if not is_of_a_lens(camera.mean_focal_length(), image.size):
        return None, "FocalLength, so the focal length is guessed"
    return camera, doubt


def accepted(camera: pycolmap.Camera, image: ImageFile) -> pycolmap.Camera:
    """The camera; UserError, which names the photo, if COLMAP does not accept it."""
    if not camera.verify_params():
        raise UserError(
            f"{shown_name(image.name)}: COLMAP does not accept the camera {camera.model_name} "
            f"{camera.params}"
        )
    return camera


@contextlib.contextmanager
def readable_by_colmap(image: ImageFile, told: ExifCamera) -> Iterator[Path]:
    """The file of a photo, or a grey JPEG with its size and the believed tags of its camera.

    Raises OSError or ImageError if the file has changed or cannot be read.
    """
    with image.path.open("rb") as file:
        ordinary = special_format(file.read(BRANDS_END), image.path.suffix) is None
    if ordinary and told.whole:
        yield image.path
        return
    width, height = image.size
    _, grey = cv2.imencode(".jpg", np.zeros((height, width), np.uint8))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        path = Path(scratch) / "camera.jpg"
        path.write_bytes(_with_exif(grey.tobytes(), told.exif()))
        yield path


def _with_exif(jpeg: bytes, exif: Image.Exif) -> bytes:
    """A JPEG with EXIF data: its segment APP1 follows the start marker (ITU-T T.81, B.1)."""
    content = exif.tobytes()
    return jpeg[:2] + b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content + jpeg[2:]
