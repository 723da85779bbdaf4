"""Writes Bundler's bundle.out (v0.3) and its list of images.

Source: Bundler v0.4 user's manual, section VI. P = R X + t, p = -P / P.z, pixels f r(p) p with
r = 1 + k1 |p|^2 + k2 |p|^4; the camera looks along -z, x points right, y up, and the origin of the
image is its centre: there is no principal point, and one focal length.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.formats.lens import (
    check_centred,
    check_no_blanks,
    check_no_tangential,
    check_one_focal,
    lens_of,
    point_tracks,
    registered_images,
)

BUNDLE, LIST = "bundle.out", "list.txt"
_FLIP = np.diag([1.0, -1.0, -1.0])


def _row(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def write_bundler(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Write cameras, points and their observations.

    Raises:
      UserError: the format cannot express a camera, or a name has a blank in it.
    """
    images = registered_images(model)
    check_no_blanks([image.name for image in images], "bundler")
    lines = ["# Bundle file v0.3", f"{len(images)} {model.num_points3D()}"]
    for image in images:
        lens = lens_of(model.camera(image.camera_id), "bundler")
        check_no_tangential(lens, "bundler")
        check_one_focal(lens, "bundler")
        check_centred(lens, "bundler")
        pose = image.cam_from_world()
        rotation = _FLIP @ pose.rotation.matrix()
        lines.append(_row([lens.fx, *lens.radial[:2]]))
        lines += [_row(row) for row in rotation]
        lines.append(_row(_FLIP @ pose.translation))
    sizes = [model.camera(image.camera_id) for image in images]
    centres = [np.array([camera.width, camera.height]) / 2 for camera in sizes]
    for _, point in point_tracks(model, images):
        seen = [str(len(point.seen))]
        for k, keypoint, xy in point.seen:
            x, y = xy - centres[k]
            seen.append(f"{k} {keypoint} {_row([x, -y])}")
        lines += [_row(point.xyz), " ".join(map(str, point.colour)), " ".join(seen)]
    (folder / BUNDLE).write_text("\n".join([*lines, ""]), encoding="utf-8")
    listed = "".join(f"{image.name}\n" for image in images)
    (folder / LIST).write_text(listed, encoding="utf-8")
