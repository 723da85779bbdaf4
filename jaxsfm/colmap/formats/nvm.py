"""Writes VisualSFM's NVM.

Source: VisualSFM's documentation of NVM_V3. A camera is NAME f (quaternion w x y z) (centre) r 0,
(x, y, 1) ~ [R | -R C] X; an observation m, in pixels from the principal point, is *undistorted* by
m (1 + r |m / f|^2). The principal point is the image's centre, unless the first line gives the one
camera of all images: NVM_V3 FixedK fx cx fy cy r.
"""

import numpy as np
import pycolmap

from jaxsfm.colmap.formats.lens import (
    Lens,
    check_no_blanks,
    point_tracks,
    radial_lens,
    registered_images,
    row_of,
)
from jaxsfm.errors import UserError

MAX_ERROR_PX = 1.0
"""Largest error of the undistortion, anywhere in the image."""


def undistortion(lens: Lens) -> float:
    """The coefficient r that undoes k1 and k2 best over the image.

    Raises UserError if the error that it leaves exceeds MAX_ERROR_PX.
    """
    k1, k2 = lens.radial[:2]
    if k1 == k2 == 0:
        return 0.0
    focal = min(lens.fx, lens.fy)
    corner = lens.corner_px / focal
    true = np.linspace(0, 2 * corner, 1000)
    measured = true * (1 + k1 * true**2 + k2 * true**4)
    end = int(np.argmax(measured >= corner)) or int(np.argmax(measured)) + 1
    true, measured = true[:end], measured[:end]
    r = float((measured**3 @ (true - measured)) / (measured**3 @ measured**3))
    error = np.abs(measured * (1 + r * measured**2) - true).max() * focal
    if not error < MAX_ERROR_PX:
        raise UserError(
            f"--to nvm: its radial distortion has one coefficient, which is {error:.1f} pixels off "
            f"for the {lens.model} camera"
        )
    return r


def nvm_text(model: pycolmap.Reconstruction) -> str:
    """The text of the file; UserError if the format cannot express a camera or an image's name."""
    images = registered_images(model)
    check_no_blanks([image.name for image in images], "nvm")
    fixed = len({image.camera_id for image in images}) == 1
    lenses = [
        radial_lens(model.camera(image.camera_id), "nvm", centred=not fixed) for image in images
    ]
    header = "NVM_V3"
    if fixed:
        one = lenses[0]
        given = (one.fx, one.cx - 0.5, one.fy, one.cy - 0.5, undistortion(one))
        header += f" FixedK {row_of(given)}"
    lines = [header, "", str(len(images))]
    for image, lens in zip(images, lenses, strict=True):
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat
        numbers = [lens.fx, w, x, y, z, *image.projection_center(), undistortion(lens)]
        lines.append(f"{image.name} {row_of(numbers)} 0")
    lines += ["", str(model.num_points3D())]
    for _, point, observed in point_tracks(model, images):
        seen = []
        for k, keypoint, xy in observed:
            seen.append(f"{k} {keypoint} {row_of(xy - (lenses[k].cx, lenses[k].cy))}")
        colour = " ".join(map(str, point.color))
        lines.append(f"{row_of(point.xyz)} {colour} {len(seen)} {' '.join(seen)}")
    return "\n".join([*lines, "", "0", ""])
