"""COLMAP's cameras and tracks in the terms of other formats, and what those can express."""

from collections.abc import Iterable, Iterator
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.colmap.formats.tables import CameraRow
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name

TOLERANCE_PX = 0.01
"""Largest error at a corner of the image that a conversion may make."""
_PERSPECTIVE = {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 2}
_FISHEYE = {"SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4}
"""COLMAP's camera models, and their numbers of radial terms."""


def row_of(values: Iterable[float]) -> str:
    """Numbers as text that reads back as the same numbers."""
    return " ".join(repr(float(v)) for v in values)


class Lens(NamedTuple):
    """A camera as OpenCV writes it, in COLMAP's pixels (centre of the top-left one (0.5, 0.5)).

    Perspective: x (1 + k1 r^2 + k2 r^4) and the tangential terms p1, p2, r the distance from the
    axis at depth 1. Fisheye: the angle t to the axis becomes t (1 + k1 t^2 + .. + k4 t^8).
    """

    model: str
    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, float, float, float]
    tangential: tuple[float, float]
    fisheye: bool

    @property
    def corner_px(self) -> float:
        """Distance from the principal point to the farthest corner, pixels."""
        width, height = self.size
        return float(np.hypot(max(self.cx, width - self.cx), max(self.cy, height - self.cy)))


def camera_of(row: CameraRow, size: tuple[int, int], where: str) -> pycolmap.Camera:
    """The camera of a row of a database; UserError, which begins with `where`, if it is none."""
    try:
        model = pycolmap.CameraModelId(row.model)
        camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=row.params)
        if camera.verify_params():
            return camera
    except (ValueError, TypeError):
        pass
    raise UserError(f"{where}: a camera of model {row.model} with {len(row.params)} parameters")


def lens_of(camera: pycolmap.Camera, to: str) -> Lens:
    """Describe a camera by one of the two formulas. Raises UserError if neither is the camera's."""
    model = camera.model_name
    fisheye = model in _FISHEYE
    if not fisheye and model not in _PERSPECTIVE:
        raise UserError(f"--to {to}: it has no camera like COLMAP's {model}")
    terms = _FISHEYE[model] if fisheye else _PERSPECTIVE[model]
    extra = [camera.params[k] for k in camera.extra_params_idxs()]
    k = [*map(float, extra[:terms]), 0.0, 0.0, 0.0, 0.0]
    p = [*map(float, extra[terms:]), 0.0, 0.0]
    return Lens(
        model=model,
        size=(camera.width, camera.height),
        fx=float(camera.focal_length_x),
        fy=float(camera.focal_length_y),
        cx=float(camera.principal_point_x),
        cy=float(camera.principal_point_y),
        radial=(k[0], k[1], k[2], k[3]),
        tangential=(p[0], p[1]),
        fisheye=fisheye,
    )


def check_one_focal(lens: Lens, to: str) -> None:
    """Raise UserError if the two focal lengths differ."""
    if abs(lens.fx / lens.fy - 1) * lens.corner_px > TOLERANCE_PX:
        raise UserError(
            f"--to {to}: it has one focal length, but the {lens.model} camera has "
            f"{lens.fx:g} and {lens.fy:g}"
        )


def radial_lens(camera: pycolmap.Camera, to: str, *, centred: bool) -> Lens:
    """`lens_of`; UserError also for fisheye cameras and tangential distortion.

    Args:
      centred: the format has one focal length, and its principal point is the image's centre.
    """
    lens = lens_of(camera, to)
    if lens.fisheye or any(lens.tangential):
        raise UserError(f"--to {to}: it has no camera like COLMAP's {lens.model}")
    if centred:
        check_one_focal(lens, to)
        off = np.hypot(lens.cx - lens.size[0] / 2, lens.cy - lens.size[1] / 2)
        if off > TOLERANCE_PX:
            raise UserError(
                f"--to {to}: its principal point is the image's centre, but the {lens.model} "
                f"camera's lies {off:.2f} pixels off (reconstruct with --cameras photo leaves it "
                "there)"
            )
    return lens


def check_no_blanks(names: Iterable[str], to: str) -> None:
    """Raise UserError for names that a format would cut in two."""
    for name in names:
        if len(name.split()) != 1 or name != name.strip():
            raise UserError(
                f"--to {to}: {shown_name(name)!r} has a blank in it, where {to} ends a name"
            )


Observed = list[tuple[int, int, np.ndarray]]
"""For each observation of a point the index of the image, that of its keypoint, and (x, y) in
COLMAP's pixels. Each image occurs once."""


def leads_out(name: str, path_type: type[PurePath] = PurePath) -> bool:
    """Whether a name, joined to a folder, gives a path that is not below the folder.

    Args:
      path_type: the kind of paths of the system. On Windows, drives (`C:a.jpg`) and the separator
        `\\` lead out as well.
    """
    path = path_type(name)
    return bool(path.anchor) or ".." in path.parts


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images with a pose, by name; UserError if a name leads out of the photos' folder."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    for image in images:
        if leads_out(image.name):
            raise UserError(f"{shown_name(image.name)}: an image outside the photos' folder")
    return sorted(images, key=lambda image: image.name)


def point_tracks(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image]
) -> Iterator[tuple[int, pycolmap.Point3D, Observed]]:
    """The points of a model and their ids, in order, and which of the images observe them."""
    index = {image.image_id: k for k, image in enumerate(images)}
    pixels = [
        np.asarray([point.xy for point in image.points2D], np.float64).reshape(-1, 2)
        for image in images
    ]
    for point_id in sorted(model.point3D_ids()):
        point = model.point3D(point_id)
        seen = {}
        for element in point.track.elements:
            k = index[element.image_id]
            seen.setdefault(k, (k, element.point2D_idx, pixels[k][element.point2D_idx]))
        yield point_id, point, list(seen.values())
