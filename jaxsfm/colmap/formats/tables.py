"""What the formats share: keypoints and matches from files of other tools, checked, in this
package's pixels, and checks of the names of images."""

import functools
from collections.abc import Iterable, Mapping, Sequence, Sized
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
import pycolmap

from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe, make_pair

MAX_KEYPOINTS = 10_000_000
"""Keypoints of one image. A file that claims more is damaged."""

MAX_SIDE = 2**31 - 1
"""Pixels of the longer side of a photo: PNG allows no more."""
MAX_NAME = 4096
"""Bytes of a name: Linux opens no longer path."""


class Tables(NamedTuple):
    """Keypoints and matches of another tool's files."""

    sizes: dict[str, tuple[int, int]]
    """Image name -> (width, height), of the images whose size the file holds."""
    focal_px: dict[str, float]
    """By image name, the focal lengths in x that were known before mapping, original pixels."""
    keypoints: dict[str, np.ndarray]
    """float32 (n, 2): (x, y), original pixels, centre of the top-left pixel (0, 0)."""
    matches: dict[Pair, np.ndarray]
    """int32 (m, 2): indices of keypoints, before verification."""
    inliers: dict[Pair, np.ndarray]
    """The same for two-view inliers; empty if nothing was verified."""


def checked_keypoints(values: np.ndarray, where: str) -> np.ndarray:
    """Check keypoints, and return their (x, y) as float32 (n, 2).

    Raises:
      UserError: they are no numbers, have fewer than two columns, or are not finite. The message
        begins with `where`.
    """
    if values.ndim != 2 or values.shape[1] < 2 or values.dtype.kind not in "fiu":
        raise UserError(f"{where}: keypoints must be numbers, n x 2; got {values.shape}")
    with np.errstate(over="ignore"):
        xy = values[:, :2].astype(np.float32)
    if not np.isfinite(xy).all():
        raise UserError(f"{where}: keypoints must be finite")
    return xy


def checked_matches(
    rows: np.ndarray, names: tuple[str, str], keypoints: Mapping[str, Sized], where: str
) -> tuple[Pair, np.ndarray]:
    """Check the matches of a pair.

    Args:
      rows: integers (m, 2), columns in the order of `names`.
      keypoints: of each image; only their number is looked at.

    Returns:
      the pair, with its names in order; int32 (m, 2), with its columns in that order.

    Raises:
      UserError: an image is matched with itself, or an index is out of range.
    """
    if names[0] == names[1]:
        raise UserError(f"{where}: {shown_name(names[0])} is matched with itself")
    for side, name in enumerate(names):
        count = len(keypoints.get(name, ()))
        if len(rows) and not (0 <= rows[:, side].min() and rows[:, side].max() < count):
            raise UserError(
                f"{where}: a match of {describe(names)} names keypoint "
                f"{max(rows[:, side].max(), rows[:, side].min(), key=abs)} of "
                f"{shown_name(name)}, which has {count}"
            )
    pair = make_pair(*names)
    return pair, (rows if pair == names else rows[:, ::-1]).astype(np.int32)


class _CameraKind(NamedTuple):
    """What a camera model of COLMAP has."""

    params: int
    focal_lengths: Sequence[int]
    """Their places among the parameters. Cameras of 360-degree photos have none."""


@functools.cache
def _camera_kind(model: int) -> _CameraKind | None:
    """The camera model with a number; None if COLMAP has none."""
    known = {int(each): each for each in pycolmap.CameraModelId.__members__.values()}
    if model < 0 or model not in known:
        return None
    example = pycolmap.Camera.create_from_model_id(1, known[model], 1.0, 1, 1)
    return _CameraKind(len(example.params), tuple(example.focal_length_idxs()))


def num_camera_params(model: int) -> int | None:
    """How many parameters a camera model has, by its number; None if there is no such model."""
    kind = _camera_kind(model)
    return kind.params if kind is not None else None


def focal_length(model: int, params: Sequence[float]) -> float | None:
    """The focal length in x of a camera that has no fault; None if its model has none."""
    kind = _camera_kind(model)
    return params[kind.focal_lengths[0]] if kind is not None and kind.focal_lengths else None


def camera_fault(model: int, size: tuple[int, int], params: Sequence[float]) -> str | None:
    """What is wrong with a camera of somebody else's, as it follows its place; None: nothing.

    Args:
      model: the number of COLMAP's camera model.
      size: width and height, pixels.
    """
    kind = _camera_kind(model)
    if kind is None:
        return f"a camera of no known model (number {model})"
    for side, value in zip(("width", "height"), size, strict=True):
        if not 1 <= value <= MAX_SIDE:
            return f"{side} must lie in 1 .. {MAX_SIDE}; got {value}"
    if len(params) != kind.params:
        return f"{kind.params} parameters expected for camera model {model}; got {len(params)}"
    if not np.isfinite(params).all():
        return "the parameters of a camera must be finite"
    for place in kind.focal_lengths:
        if params[place] <= 0:
            return f"the focal length must be positive; got {params[place]:g}"
    return None


def name_fault(name: str) -> str | None:
    """What is wrong with the name of an image, as it follows its place; None: nothing."""
    try:
        data = name.encode("utf-8")
    except UnicodeEncodeError:
        return "a name that is not UTF-8"
    if b"\0" in data or not _path_of(name):
        return f"{shown_name(name)[:80]!r} names no file"
    if len(data) > MAX_NAME:
        return f"a name of {len(data)} bytes"
    return None


def _path_of(name: str) -> str:
    """A name without what a path may have more than it needs, as in ./a//b.jpg."""
    return "/".join(part for part in name.split("/") if part not in ("", "."))


def clash(names: Iterable[str]) -> tuple[str, str] | None:
    """Two of the names that cannot both be files of one folder; None if there are none.

    They name one file, as a.jpg and ./a.jpg do, or one is a folder of the other one.
    """
    # If / comes before all other letters, all that is below a name follows it at once.
    paths = sorted((_path_of(name).replace("/", "\0"), name) for name in names)
    for (path, name), (after, other) in zip(paths, paths[1:], strict=False):
        if f"{after}\0".startswith(f"{path}\0"):
            return name, other
    return None


def clash_fault(names: tuple[str, str]) -> str:
    """What is wrong with two names that clash, as it follows their place."""
    first, second = (repr(shown_name(name)[:80]) for name in names)
    return f"{first} and {second} cannot both be files of one folder"


def check_no_blanks(names: Iterable[str], to: str) -> None:
    """Raise UserError for names that a format would cut in two."""
    for name in names:
        if len(name.split()) != 1 or name != name.strip():
            raise UserError(
                f"--to {to}: {shown_name(name)!r} has a blank in it, where {to} ends a name"
            )


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
