"""Known cameras, and whether they are those of the photos."""

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np
import pycolmap

from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, shown_name
from jaxsfm.io.orientation import QUARTERS, to_stored

MODELS = tuple(sorted(pycolmap.CameraModelId.__members__.keys() - {"INVALID", "EQUIRECTANGULAR"}))
"""COLMAP's camera models whose pixels lie on a plane."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A known camera."""

    model: str
    params: tuple[float, ...]
    """Parameters of the COLMAP model, in COLMAP's pixels."""
    size: tuple[int, int] | None = None
    """(width, height) of the photos, if whoever gave the camera said so."""

    def camera(self, size: tuple[int, int]) -> pycolmap.Camera:
        """The COLMAP camera for images of `size` (width, height), marked as known.

        The mark (`has_prior_focal_length`) makes COLMAP verify pairs as calibrated. Without it,
        entry-P10 has 0.78 m mean error instead of 0.018 m.
        """
        camera = pycolmap.Camera(
            model=self.model, width=size[0], height=size[1], params=list(self.params)
        )
        camera.has_prior_focal_length = True
        return camera

    def turned(self, size: tuple[int, int], orientation: int) -> "Intrinsics":
        """The same camera, for photos that are stored turned.

        Args:
          size: (width, height) of the photos as they are stored.
          orientation: how they are turned to be as the camera saw them; no mirrored one.

        Raises:
          UserError: the camera has parameters for which it is not known how to turn them.
        """
        info = pycolmap.Camera.create_from_model_name(0, self.model, 1.0, *size).params_info
        named = dict(zip(info.split(", "), self.params, strict=True))
        if unknown := sorted(named.keys() - _TURNABLE):
            raise UserError(
                f"--intrinsics {self.model}: some photos are stored turned, and {unknown[0]} of "
                "this camera cannot be turned with them; turn the photos' pixels first"
            )
        matrix = to_stored(size, orientation)  # in pixels whose centres are at whole numbers
        cx, cy = matrix[:2] @ [named["cx"] - 0.5, named["cy"] - 0.5, 1.0] + 0.5
        turned = named | {"cx": cx, "cy": cy}
        if "p1" in named:  # the tangential distortion is along the vector (p2, p1)
            turned["p2"], turned["p1"] = matrix[:2, :2] @ [named["p2"], named["p1"]]
        if "fx" in named and matrix[0, 0] == 0:
            turned |= {"fx": named["fy"], "fy": named["fx"]}
        return Intrinsics(model=self.model, params=tuple(map(float, turned.values())))


_TURNABLE = {"f", "fx", "fy", "cx", "cy", "k", "p1", "p2", *(f"k{n}" for n in range(1, 7))}
"""Parameters of cameras that turn as focal lengths, principal points and radial or tangential
distortion do."""

KnownCameras = Intrinsics | Mapping[str, Intrinsics]
"""One camera of all images, or the cameras of all images by their names."""


def camera_of(known: KnownCameras, image: ImageFile, *, upright: bool = False) -> Intrinsics:
    """The known camera of the pixels of an image as they are stored.

    Args:
      upright: whether one known camera is that of the upright image, in any case.
    """
    if not isinstance(known, Intrinsics):
        return known[image.name]
    if upright or is_turned(known, image):
        return known.turned(image.size, image.orientation)
    return known


def used_cameras(known: KnownCameras, images: Iterable[ImageFile]) -> KnownCameras:
    """The known cameras without those of a list that no image has: they are not what a run depends
    on."""
    if isinstance(known, Intrinsics):
        return known
    return {image.name: known[image.name] for image in images if image.name in known}


def is_turned(camera: Intrinsics, image: ImageFile) -> bool:
    """Whether the image has the camera's size only when it is upright."""
    if image.orientation not in QUARTERS or image.upright_size == image.size:
        return False
    known = camera.camera(image.size)
    centre = np.asarray([known.principal_point_x, known.principal_point_y])
    stored, upright = (
        np.linalg.norm(centre - np.asarray(size) / 2) for size in (image.size, image.upright_size)
    )
    return bool(upright < stored)


def sizes_of(known: KnownCameras, images: Iterable[ImageFile]) -> dict[str, tuple[int, int]]:
    """(width, height) of images as their known cameras saw them, by name."""
    return {
        image.name: image.upright_size
        if isinstance(known, Intrinsics) and is_turned(known, image)
        else image.size
        for image in images
    }


def check_fits(intrinsics: KnownCameras, sizes: dict[str, tuple[int, int]]) -> None:
    """Raise UserError unless all images have a camera and hold its principal point, and the images
    of one camera have one size, which is that of the camera if it has any.

    Args:
      sizes: image name -> (width, height).
    """
    if not isinstance(intrinsics, Intrinsics):
        for name, size in sizes.items():
            if name not in intrinsics:
                raise UserError(f"--intrinsics: the list has no camera of {shown_name(name)}")
            check_fits(intrinsics[name], {name: size})
        return
    check_one_size(sizes, "--intrinsics describe")
    for name, (width, height) in sizes.items():
        if intrinsics.size not in (None, (width, height)):
            raise UserError(
                f"--intrinsics: the camera of {shown_name(name)} is for {intrinsics.size[0]} x "
                f"{intrinsics.size[1]} pixels, but the photo has {width} x {height}"
            )
    for width, height in set(sizes.values()):
        camera = intrinsics.camera((width, height))
        cx, cy = camera.principal_point_x, camera.principal_point_y
        if not (0 < cx < width and 0 < cy < height):
            raise UserError(
                f"--intrinsics: the principal point ({cx:g}, {cy:g}) lies outside the "
                f"{width} x {height} images"
            )


def check_one_size(sizes: Mapping[str, tuple[int, int]], option: str) -> None:
    """Raise UserError unless all images have one size.

    Args:
      sizes: image name -> (width, height).
      option: the beginning of the sentence: what there is one camera for.
    """
    by_size: dict[tuple[int, int], list[str]] = {}
    for name, size in sizes.items():
        by_size.setdefault(size, []).append(name)
    if len(by_size) > 1:
        shown = "; ".join(
            f"{w} x {h}: {len(names)} (e.g. {shown_name(names[0])})"
            for (w, h), names in by_size.items()
        )
        raise UserError(f"{option} one camera, but the images differ in size: {shown}")
