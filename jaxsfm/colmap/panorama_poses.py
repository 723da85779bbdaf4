"""The poses of panoramas: from the poses of their views, and as a table, `panoramas.csv`."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.poses import CameraPose, Poses, nearest_rotation
from jaxsfm.core.panorama import ViewSet
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic

COLUMNS = ("name", "model", "x", "y", "z", "qw", "qx", "qy", "qz")
NOTE = """\
# The poses of panoramas, in the coordinates of the model sparse/MODEL (column model).
# x y z: the centre. qw qx qy qz: the rotation from the world into the panorama's frame,
# in which x points right, y down, and z forward, through the middle of the picture.
# The panorama shows the direction (dx, dy, dz) of its frame at the pixel
#   u = width * (0.5 + atan2(dx, dz) / (2 pi)), v = height * (0.5 + atan2(dy, hypot(dx, dz)) / pi),
# where (0, 0) is the corner of the top-left pixel and (0.5, 0.5) its centre, as in COLMAP.
"""


def panorama_poses(
    poses: Poses, views: ViewSet, view_of: Mapping[str, tuple[str, int]]
) -> dict[str, CameraPose]:
    """The poses of the panoramas whose views have poses, by the panoramas' names.

    The views of one panorama are one rig, so all of them say the same; where they do not, it is the
    mean.

    Args:
      view_of: of each view, the name of its panorama and which of `views` it is.
    """
    rotations = views.rotations()
    found: dict[str, list[CameraPose]] = {}
    for name in sorted(poses.keys() & view_of.keys()):
        panorama, index = view_of[name]
        own = CameraPose(rotations[index].T @ poses[name].rotation, poses[name].centre)
        found.setdefault(panorama, []).append(own)
    return {name: _mean(each) for name, each in sorted(found.items())}


def _mean(poses: Sequence[CameraPose]) -> CameraPose:
    """The mean centre, and the rotation that is nearest to the mean of the matrices."""
    turn = nearest_rotation(np.mean([pose.rotation for pose in poses], axis=0))
    return CameraPose(turn, np.mean([pose.centre for pose in poses], axis=0))


def write_panorama_table(path: Path, models: Sequence[Mapping[str, CameraPose]]) -> None:
    """Write the poses of the panoramas of models, by name, the best model first."""
    text = io.StringIO()
    text.write(NOTE)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for number, poses in enumerate(models):
        for name, pose in poses.items():
            x, y, z, w = pycolmap.Rotation3d(pose.rotation).quat
            numbers = [f"{value:.12g}" for value in (*pose.centre, w, x, y, z)]
            writer.writerow([name, number, *numbers])
    write_atomic(path, text.getvalue().encode())


def read_panorama_table(path: Path) -> list[dict[str, CameraPose]]:
    """Read what `write_panorama_table` wrote; a model without panoramas before others is empty.

    Raises:
      UserError: the file cannot be read, or is no such table.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as text") from error
    models: list[dict[str, CameraPose]] = []
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    try:
        for row in rows:
            x, y, z, qw, qx, qy, qz = (float(row[name]) for name in COLUMNS[2:])
            number = int(row["model"])
            if not 0 <= number < 1000:
                raise ValueError(f"model {number}")
            models += [{} for _ in range(number + 1 - len(models))]
            rotation = pycolmap.Rotation3d(np.asarray([qx, qy, qz, qw])).matrix()
            models[number][row["name"]] = CameraPose(rotation, np.asarray([x, y, z]))
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path}: not a table of panoramas ({error})") from error
    return models
