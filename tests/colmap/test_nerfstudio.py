"""nerfstudio's own projection formula puts the exported points where the model sees them.

The reader here is written from nerfstudio's specification, not from our writer.
"""

import json

import numpy as np
import pycolmap
import pytest
from foreign_model import CAMERAS, SIZE, camera, exact_model
from plyfile import PlyData

from jaxsfm.colmap.formats.nerfstudio import write_nerfstudio
from jaxsfm.errors import UserError


def observations(model):
    """{(image name, point's number): (x, y)}, COLMAP's pixels."""
    return {
        (image.name, int(model.point3D(p.point3D_id).color[0])): p.xy
        for image in model.images.values()
        for p in image.points2D
        if p.has_point3D()
    }


def nerfstudio_pixels(frame, meta, world):
    """Where nerfstudio's camera sees a point; rays leave (column + 0.5, row + 0.5)."""
    own = {**meta, **frame}
    to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
    x, y, z = (to_camera @ np.append(world, 1))[:3]
    p = np.array([x, -y]) / -z  # looking along -z, y up
    r2 = p @ p
    if meta["camera_model"] == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        t = np.arctan(r)
        d = p / r * (t + sum(own[f"k{i}"] * t ** (2 * i + 1) for i in (1, 2, 3, 4)))
    else:
        x, y = p
        p1, p2 = own["p1"], own["p2"]
        tangent = [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        d = p * (1 + own["k1"] * r2 + own["k2"] * r2**2) + tangent
    return d * (own["fl_x"], own["fl_y"]) + (own["cx"], own["cy"])


@pytest.mark.parametrize("kind", list(CAMERAS))
@pytest.mark.parametrize("shared", [True, False])
def test_nerfstudio_projects_onto_the_models_keypoints(tmp_path, kind, shared):
    other = [camera(kind, 2, [CAMERAS[kind][0] + 50, *CAMERAS[kind][1:]])]
    model = exact_model([camera(kind), *other * (not shared)])
    write_nerfstudio(tmp_path, model, None)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    assert ("fl_x" in meta) == shared
    vertices = PlyData.read(tmp_path / meta["ply_file_path"])["vertex"]
    truth = observations(model)
    for frame in meta["frames"]:
        name = frame["file_path"].removeprefix("images/")
        for vertex in vertices:
            if (name, int(vertex["red"])) in truth:
                seen = truth.pop((name, int(vertex["red"])))
                world = [float(vertex[axis]) for axis in "xyz"]
                # the point cloud is float32
                assert np.allclose(nerfstudio_pixels(frame, meta, world), seen, atol=1e-3)
    assert not truth
    # The transform that was applied leads back to the model's own world.
    turned = np.array(meta["applied_transform"])
    back = np.array([[float(v[a]) for a in "xyz"] for v in vertices]) @ turned[:, :3]
    own = np.array([point.xyz for point in model.points3D.values()])
    assert np.allclose(np.sort(back, axis=0), np.sort(own, axis=0), atol=1e-5)


@pytest.mark.parametrize("kind", ["FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"])
def test_a_camera_that_nerfstudio_lacks_is_refused_by_name(tmp_path, kind):
    params = [*pycolmap.Camera.create_from_model_name(1, kind, 900.0, *SIZE).params]
    with pytest.raises(UserError, match=f"--to nerfstudio: .*{kind}"):
        write_nerfstudio(tmp_path, exact_model([camera(kind, 1, params)]), None)


def test_perspective_and_fisheye_together_are_refused(tmp_path):
    model = exact_model([camera("PINHOLE"), camera("OPENCV_FISHEYE", 2)])
    with pytest.raises(UserError, match="OPENCV_FISHEYE, PINHOLE"):
        write_nerfstudio(tmp_path, model, None)
