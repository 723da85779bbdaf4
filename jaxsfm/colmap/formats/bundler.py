"""Writes Bundler's bundle.out (v0.3) and its list of images.

Source: Bundler v0.4 user's manual, section VI. P = R X + t, p = -P / P.z, pixels f r(p) p with
r = 1 + k1 |p|^2 + k2 |p|^4; the camera looks along -z, x points right, y up, and the origin of the
image is its centre: there is no principal point, and one focal length.
"""

from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.formats.lens import (
    check_no_blanks,
    point_tracks,
    radial_lens,
    registered_images,
    row_of,
)

BUNDLE, LIST = "bundle.out", "list.txt"
_FLIP = np.diag([1.0, -1.0, -1.0])


def write_bundler(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Write cameras, points and observations.

    Raises UserError if the format cannot express a camera or an image's name.
    """
    images = registered_images(model)
    check_no_blanks([image.name for image in images], "bundler")
    lines = ["# Bundle file v0.3", f"{len(images)} {model.num_points3D()}"]
    for image in images:
        lens = radial_lens(model.camera(image.camera_id), "bundler", centred=True)
        pose = image.cam_from_world()
        rotation = _FLIP @ pose.rotation.matrix()
        lines.append(row_of([lens.fx, *lens.radial[:2]]))
        lines += [row_of(row) for row in rotation]
        lines.append(row_of(_FLIP @ pose.translation))
    sizes = [model.camera(image.camera_id) for image in images]
    centres = [np.array([camera.width, camera.height]) / 2 for camera in sizes]
    for _, point, observed in point_tracks(model, images):
        seen = [str(len(observed))]
        for k, keypoint, xy in observed:
            x, y = xy - centres[k]
            seen.append(f"{k} {keypoint} {row_of([x, -y])}")
        lines += [row_of(point.xyz), " ".join(map(str, point.color)), " ".join(seen)]
    (folder / BUNDLE).write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")
    listed = "".join(f"{image.name}\n" for image in images)
    (folder / LIST).write_text(listed, encoding="utf-8", newline="\n")
