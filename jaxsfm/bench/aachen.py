"""Aachen Day-Night in its own layout (Sattler et al., CVPR 2018), as a scene of `bench daynight`.

    images_upright/            the photos
    3D-models/                 a COLMAP model (version 1.1) or an NVM file (version 1), with the
                               reference poses of the database photos
    queries/*intrinsics*.txt   the cameras of the queries: lines of NAME MODEL w h params...
    image_pairs_to_match.txt   lines of two names, which pair night photos with day photos

The cameras of the database photos are those of such a list, also at the top or in 3D-models, or
those of the COLMAP model. Poses of queries are withheld: the evaluation server of
visuallocalization.net takes them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsfm.bench.scenes import PHOTOS, Scene, Subset, check_cameras, inspected, reference_of
from jaxsfm.colmap.given_cameras import read_camera_list
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.model_files import read_model
from jaxsfm.colmap.poses import CameraPose, Poses, model_poses
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.images import ImageFile

PAIRS = "image_pairs_to_match.txt"
NVM_COLUMNS = 11
"""NAME, focal length, quaternion (w, x, y, z), centre, distortion, 0."""


def _lines(path: Path, option: str) -> list[list[str]]:
    """The words of each line that is neither empty nor a comment."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{option}: {path} cannot be read as text") from error
    return [words for line in lines if (words := line.split()) and not words[0].startswith("#")]


def read_subsets(root: Path, path: Path | None) -> list[Subset]:
    """The subsets that are reconstructed, by the names of their night photos.

    Args:
      path: a file whose lines name a night photo and then its day photos; None takes the photos
        that `PAIRS` pairs.

    Raises:
      UserError: the file cannot be read, or names no subset.
    """
    option = "--root" if path is None else "--subsets"
    file = path or root / PAIRS
    paired: dict[str, set[str]] = {}
    for words in _lines(file, option):
        if path is not None:
            paired.setdefault(words[0], set()).update(words[1:])
            continue
        dark = [name for name in words if "night" in name.split("/")]
        if len(words) == 2 and len(dark) == 1:
            paired.setdefault(dark[0], set()).update(set(words) - set(dark))
    if not paired or not all(paired.values()):
        raise UserError(f"{option}: {file} must name night photos, each with day photos")
    return [Subset(sorted(day), night) for night, day in sorted(paired.items())]


def read_nvm(path: Path) -> Poses:
    """The poses in an NVM file.

    Raises:
      UserError: the file is not of this format.
    """
    lines = _lines(path, "--root")
    poses: Poses = {}
    try:
        if lines[0][0] != "NVM_V3":
            raise ValueError("no NVM_V3 in the first line")
        for words in lines[2 : 2 + int(lines[1][0])]:
            if len(words) != NVM_COLUMNS:
                raise ValueError(f"{len(words)} columns for a camera instead of {NVM_COLUMNS}")
            w, x, y, z, *centre = (float(word) for word in words[2:9])
            if not np.isfinite([w, x, y, z, *centre]).all():
                raise ValueError("a pose that is not finite")
            poses[words[0]] = CameraPose(
                Rotation.from_quat([x, y, z, w]).as_matrix(), np.asarray(centre)
            )
    except (ValueError, IndexError) as error:
        raise UserError(f"--root: {path} is not an NVM file ({error})") from error
    return poses


def read_reference(root: Path) -> tuple[Poses, dict[str, Intrinsics]]:
    """The poses of the database photos, and their cameras if the model is one of COLMAP.

    Raises:
      UserError: there is no model, or it cannot be read.
    """
    folder = root / "3D-models"
    models = sorted(p.parent for name in ("bin", "txt") for p in folder.rglob(f"images.{name}"))
    if models:
        model = read_model(models[0])
        cameras = {}
        for image in (model.image(k) for k in model.reg_image_ids()):
            camera = model.cameras[image.camera_id]
            cameras[image.name] = Intrinsics(
                model=camera.model_name,
                params=tuple(camera.params),
                size=(camera.width, camera.height),
            )
        return model_poses(model), cameras
    files = sorted(folder.rglob("*.nvm"))
    if not files:
        raise UserError(f"--root {root}: no COLMAP model and no NVM file below 3D-models")
    return read_nvm(files[0]), {}


def read_cameras(root: Path) -> dict[str, Intrinsics]:
    """The cameras of all lists of intrinsics, by photo.

    Raises:
      UserError: a list holds anything else.
    """
    name = "*intrinsics*.txt"
    lists = [*root.glob(name), *root.glob(f"quer*/{name}"), *(root / "3D-models").rglob(name)]
    cameras: dict[str, Intrinsics] = {}
    for path in sorted(lists):
        cameras |= read_camera_list(path, "--root")
    return cameras


def _known_cameras(
    root: Path, images: dict[str, ImageFile], cameras: Mapping[str, Intrinsics]
) -> dict[str, Intrinsics]:
    """The cameras of the photos that are used, after a check of their sizes."""
    for name in images:
        if name not in cameras:
            raise UserError(
                f"--root {root}: no intrinsics of {name}; expected a line NAME MODEL w h params in "
                "queries/night_time_queries_with_intrinsics.txt or database_intrinsics.txt"
            )
    known = {name: cameras[name] for name in images}
    check_cameras(known, images, root)
    return known


def aachen_scene(root: Path, subsets: Path | None = None) -> Scene:
    """Read Aachen Day-Night. All cameras are known.

    Args:
      subsets: a file of subsets (`read_subsets`).

    Raises:
      UserError: a file is missing or damaged.
    """
    chosen = read_subsets(root, subsets)
    poses, of_model = read_reference(root)
    wanted = sorted({name for subset in chosen for name in (*subset.day, subset.night)})
    images = inspected(root / PHOTOS, wanted)
    cameras = _known_cameras(root, images, of_model | read_cameras(root))
    truth = reference_of(root.name, images, poses)
    return Scene(root / PHOTOS, images, chosen, truth, cameras, False)


def submission_row(name: str, pose: Sequence[float]) -> str:
    """A line for the evaluation server: the file's name without folders, and the pose."""
    return " ".join([Path(name).name, *(f"{value:.12g}" for value in pose)])


def write_submission(folder: Path, method: str, poses: Mapping[str, Sequence[float]]) -> Path:
    """Write the file that the evaluation server takes, `Aachen_eval_METHOD.txt`; returns its path.

    Args:
      poses: by photo, qw qx qy qz tx ty tz: the unit quaternion of the rotation from the world to
        the camera, and the translation.
    """
    path = folder / f"Aachen_eval_{method}.txt"
    lines = [submission_row(name, pose) + "\n" for name, pose in sorted(poses.items())]
    write_atomic(path, "".join(lines).encode())
    return path
