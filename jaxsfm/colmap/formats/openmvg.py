"""Writes OpenMVG's sfm_data.json (version 0.3), and its features and matches as text.

Source: OpenMVG's sfm_data_io_cereal.cpp, cameras/*_io.hpp, matching/indMatch_utils.cpp. Cameras
have one focal length; poses are a rotation world to camera and a centre; pixels count from the
centre of the top-left one. Cereal names a type where it first occurs (bit 31 of its id) and
numbers the objects behind pointers likewise.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from jaxsfm.colmap.formats.lens import (
    Lens,
    check_one_focal,
    lens_of,
    point_tracks,
    registered_images,
)
from jaxsfm.colmap.formats.tables import Tables
from jaxsfm.errors import UserError
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair

SFM_DATA, MATCHES = "sfm_data.json", "matches"
_NEW, _EXACT = 1 << 31, 1 << 30
"""Cereal's marks for the first occurrence of a type, and for a pointer to the declared type."""


def _intrinsic(lens: Lens) -> tuple[str, dict[str, object]]:
    """OpenMVG's name of a camera model, and the camera's parameters."""
    check_one_focal(lens, "openmvg")
    data: dict[str, object] = {
        "width": lens.size[0],
        "height": lens.size[1],
        "focal_length": lens.fx,
        "principal_point": [lens.cx - 0.5, lens.cy - 0.5],
    }
    k1, k2 = lens.radial[:2]
    if lens.fisheye:
        return "fisheye", data | {"fisheye": list(lens.radial)}
    if any(lens.tangential):
        return "pinhole_brown_t2", data | {"disto_t2": [k1, k2, 0.0, *lens.tangential]}
    if k2:
        return "pinhole_radial_k3", data | {"disto_k3": [k1, k2, 0.0]}
    if k1:
        return "pinhole_radial_k1", data | {"disto_k1": [k1]}
    return "pinhole", data


def _keyed(values: Iterable[tuple[int, object]]) -> list[dict[str, object]]:
    return [{"key": key, "value": value} for key, value in values]


def sfm_data(
    cameras: Mapping[str, pycolmap.Camera],
    model: pycolmap.Reconstruction | None,
    root: Path | None,
) -> dict[str, object]:
    """The content of sfm_data.json: views, cameras, poses and points.

    Args:
      cameras: by image name, of images with and without a pose. For images with a pose they are
        the cameras of the model.
      model: poses and points; None: there are none.

    Raises:
      UserError: OpenMVG does not have a camera.
    """
    names = sorted(cameras)
    lenses = {name: lens_of(camera, "openmvg") for name, camera in cameras.items()}
    distinct = list(dict.fromkeys(lenses[name] for name in names))
    pointers = iter(range(1, 1 << 30))
    views = []
    for k, name in enumerate(names):
        path = PurePosixPath(name)
        data = {
            "local_path": f"{path.parent}/" if len(path.parts) > 1 else "",
            "filename": path.name,
            "width": lenses[name].size[0],
            "height": lenses[name].size[1],
            "id_view": k,
            "id_intrinsic": distinct.index(lenses[name]),
            "id_pose": k,
        }
        wrapper = {"id": _NEW + next(pointers), "data": data}
        views.append((k, {"polymorphic_id": _EXACT, "ptr_wrapper": wrapper}))
    types: dict[str, int] = {}
    intrinsics = []
    for k, lens in enumerate(distinct):
        kind, data = _intrinsic(lens)
        value: dict[str, object] = {"polymorphic_id": types.get(kind, _NEW + len(types) + 1)}
        if kind not in types:
            types[kind] = len(types) + 1
            value["polymorphic_name"] = kind
        value["ptr_wrapper"] = {"id": _NEW + next(pointers), "data": data}
        intrinsics.append((k, value))
    poses, points = [], []
    if model is not None:
        images = registered_images(model)
        keys = [names.index(image.name) for image in images]
        for key, image in zip(keys, images, strict=True):
            rotation = image.cam_from_world().rotation.matrix().tolist()
            pose = {"rotation": rotation, "center": image.projection_center().tolist()}
            poses.append((key, pose))
        for point_id, point, observed in point_tracks(model, images):
            seen = [(keys[k], {"id_feat": f, "x": (xy - 0.5).tolist()}) for k, f, xy in observed]
            points.append((point_id, {"X": point.xyz.tolist(), "observations": _keyed(seen)}))
    return {
        "sfm_data_version": "0.3",
        "root_path": str(root or ""),
        "views": _keyed(views),
        "intrinsics": _keyed(intrinsics),
        "extrinsics": _keyed(poses),
        "structure": _keyed(points),
        "control_points": [],
    }


def write_features(folder: Path, tables: Tables) -> None:
    """Write NAME.feat (x y scale orientation on each line), matches.putative.txt and matches.f.txt.

    Views are numbered by name, as in `sfm_data`. Scale and orientation are 1 and 0. Raises
    UserError if the names of two images differ in folder or ending only.
    """
    names = sorted(tables.sizes)
    stems = Counter(PurePosixPath(name).stem for name in names)
    for name in names:
        stem = PurePosixPath(name).stem
        if stems[stem] > 1:
            raise UserError(
                f"--to openmvg: {shown_name(name)} and another image would both have the features "
                f"{shown_name(stem)}.feat"
            )
        xy = tables.keypoints.get(name, np.zeros((0, 2), np.float32))
        lines = "".join(f"{x:.9g} {y:.9g} 1 0\n" for x, y in xy.tolist())
        (folder / f"{stem}.feat").write_text(lines, encoding="utf-8", newline="\n")
    for kind, found in (("putative", tables.matches), ("f", tables.inliers)):
        _write_matches(folder / f"matches.{kind}.txt", names, found)


def _write_matches(path: Path, names: list[str], found: Mapping[Pair, np.ndarray]) -> None:
    number = {name: k for k, name in enumerate(names)}
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for (a, b), rows in sorted(found.items()):
            file.write(f"{number[a]} {number[b]}\n{len(rows)}\n")
            file.writelines(f"{i} {j}\n" for i, j in rows.tolist())


def write_openmvg(folder: Path, record: dict[str, object], tables: Tables | None) -> None:
    """Write sfm_data.json, and features and matches into the folder `matches`.

    `id_feat` counts the keypoints of the model, which refinement has moved. The features and the
    matches are those of the database.
    """
    (folder / SFM_DATA).write_text(json.dumps(record, indent=1), encoding="utf-8", newline="\n")
    if tables is not None:
        (folder / MATCHES).mkdir()
        write_features(folder / MATCHES, tables)
