"""Every format with cameras: its own projection formula puts the points where the model sees them.

The readers here are written from the formats' specifications, not from our writers.
"""

import json

import numpy as np
import pytest
from foreign_model import CAMERAS, NAMES, SIZE, camera, exact_model
from plyfile import PlyData

from jaxsfm.colmap.formats.bundler import write_bundler
from jaxsfm.colmap.formats.nerfstudio import write_nerfstudio
from jaxsfm.colmap.formats.nvm import nvm_text
from jaxsfm.colmap.formats.openmvg import sfm_data
from jaxsfm.errors import UserError

EXACT_PX = 1e-6
PERSPECTIVE = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
ONE_FOCAL = ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"]
FISHEYE = ["SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"]


def observations(model):
    """{(image name, point's number): (keypoint index, x, y)}, COLMAP's pixels."""
    return {
        (image.name, int(model.point3D(p.point3D_id).color[0])): (k, *p.xy)
        for image in model.images.values()
        for k, p in enumerate(image.points2D)
        if p.has_point3D()
    }


def one_focal(model: str) -> list[float]:
    """Parameters of a camera with one focal length and a principal point off the centre."""
    params = list(CAMERAS[model])
    if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE"):
        params[1] = params[0]
    else:
        params[1:3] = [500, 390]
    return params


def tokens(path):
    return iter(path.read_text(encoding="utf-8").split())


def read_bundle(folder):
    """Yields (name, point's number, keypoint, seen, projected), pixels from the centre, y up."""
    text = (folder / "bundle.out").read_text()
    assert text.startswith("# Bundle file v0.3\n")
    words = iter(text.split("\n", 1)[1].split())
    names = (folder / "list.txt").read_text().splitlines()
    num_cameras, num_points = int(next(words)), int(next(words))
    assert num_cameras == len(names)

    def floats(n):
        return np.array([float(next(words)) for _ in range(n)])

    cameras = [(floats(3), floats(9).reshape(3, 3), floats(3)) for _ in names]
    for _ in range(num_points):
        xyz, colour = floats(3), [int(next(words)) for _ in range(3)]
        for _ in range(int(next(words))):
            k, keypoint = int(next(words)), int(next(words))
            (f, k1, k2), rotation, translation = cameras[k]
            at = rotation @ xyz + translation
            p = -at[:2] / at[2]
            r2 = p @ p
            yield names[k], colour[0], keypoint, floats(2), f * (1 + k1 * r2 + k2 * r2**2) * p
    assert next(words, None) is None


@pytest.mark.parametrize("kind", ONE_FOCAL)
def test_bundler_projects_onto_its_observations(tmp_path, kind):
    model = exact_model([camera(kind), camera(kind, 2)])
    write_bundler(tmp_path, model)
    truth = observations(model)
    for name, point, keypoint, seen, projected in read_bundle(tmp_path):
        index, x, y = truth.pop((name, point))
        assert keypoint == index
        assert np.allclose(seen, [x - SIZE[0] / 2, SIZE[1] / 2 - y], atol=EXACT_PX)
        assert np.allclose(projected, seen, atol=EXACT_PX)
    assert not truth


def rotation_of(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_nvm(text):
    """Yields (name, point's number, keypoint, undistorted observation, projected)."""
    first, _, rest = text.partition("\n")
    head = first.split()
    assert head[0] == "NVM_V3"
    fixed = [float(v) for v in head[2:]] if head[1:2] == ["FixedK"] else None
    words = iter(rest.split())
    cameras = []
    for _ in range(int(next(words))):
        name = next(words)
        values = [float(next(words)) for _ in range(9)]
        assert next(words) == "0"
        fx = fy = values[0]
        if fixed:
            fx, fy = fixed[0], fixed[2]
            assert fixed[4] == values[8]
        cameras.append((name, fx, fy, rotation_of(*values[1:5]), np.array(values[5:8]), values[8]))
    for _ in range(int(next(words))):
        xyz = np.array([float(next(words)) for _ in range(3)])
        colour = [int(next(words)) for _ in range(3)]
        for _ in range(int(next(words))):
            k, keypoint = int(next(words)), int(next(words))
            seen = np.array([float(next(words)), float(next(words))])
            name, fx, fy, rotation, centre, r = cameras[k]
            at = rotation @ (xyz - centre)
            flat = seen / (fx, fy)
            straight = seen * (1 + r * flat @ flat)
            yield name, colour[0], keypoint, seen, straight, at[:2] / at[2] * (fx, fy)
    assert next(words) == "0"


@pytest.mark.parametrize("kind", ["PINHOLE", *ONE_FOCAL])
@pytest.mark.parametrize("shared", [True, False])
def test_nvm_projects_onto_its_observations(kind, shared):
    params = CAMERAS[kind] if shared else {"PINHOLE": [900.0, 900, 512, 384]}.get(kind)
    model = exact_model([camera(kind, 1, params)] + [camera(kind, 2, params)] * (not shared))
    cx, cy = params[2:] if kind == "PINHOLE" and params else (512, 384)
    truth = observations(model)
    # What one coefficient of undistortion cannot say is bounded; without distortion it is exact.
    tolerance = 1.0 if "RADIAL" in kind else EXACT_PX
    text = nvm_text(model)
    if shared:
        one = camera(kind)
        head = [float(v) for v in text.split("\n")[0].split()[2:6]]
        assert head == [one.focal_length_x, cx - 0.5, one.focal_length_y, cy - 0.5]
    for name, point, keypoint, seen, straight, projected in read_nvm(text):
        index, x, y = truth.pop((name, point))
        assert keypoint == index
        assert np.allclose(seen, [x - cx, y - cy], atol=EXACT_PX)
        assert np.linalg.norm(straight - projected) < tolerance
    assert not truth


def distorted(p, kind, data):
    """OpenMVG's add_disto."""
    r2 = p @ p
    if kind == "fisheye":
        r = np.sqrt(r2)
        t = np.arctan(r)
        k = data["fisheye"]
        return p * (t + sum(k[i] * t ** (2 * i + 3) for i in range(4))) / r
    if kind == "pinhole_brown_t2":
        k1, k2, k3, t1, t2 = data["disto_t2"]
        x, y = p
        tangent = [t2 * (r2 + 2 * x * x) + 2 * t1 * x * y, t1 * (r2 + 2 * y * y) + 2 * t2 * x * y]
        return p * (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) + tangent
    k1, k2, k3 = [*data.get("disto_k3", data.get("disto_k1", [])), 0, 0, 0][:3]
    return p * (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3)


@pytest.mark.parametrize("kind", ["OPENCV", "OPENCV_FISHEYE", *ONE_FOCAL, *FISHEYE])
def test_openmvg_projects_onto_its_observations(kind):
    model = exact_model([camera(kind, 1, one_focal(kind))])
    cameras = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    record = json.loads(json.dumps(sfm_data(cameras, model, None)))
    assert list(record) == [
        "sfm_data_version", "root_path", "views", "intrinsics", "extrinsics", "structure",
        "control_points",
    ]  # fmt: skip
    views = {v["key"]: v["value"]["ptr_wrapper"]["data"] for v in record["views"]}
    assert [v["local_path"] + v["filename"] for v in views.values()] == sorted(NAMES)
    (intrinsic,) = record["intrinsics"]
    value = intrinsic["value"]
    data = value["ptr_wrapper"]["data"]
    poses = {p["key"]: p["value"] for p in record["extrinsics"]}
    truth = observations(model)
    number = {point_id: int(model.point3D(point_id).color[0]) for point_id in model.points3D}
    for point in record["structure"]:
        for seen in point["value"]["observations"]:
            view = views[seen["key"]]
            pose = poses[view["id_pose"]]
            at = np.array(pose["rotation"]) @ (np.array(point["value"]["X"]) - pose["center"])
            p = distorted(at[:2] / at[2], value["polymorphic_name"], data)
            projected = data["focal_length"] * p + data["principal_point"]
            key = view["local_path"] + view["filename"], number[point["key"]]
            index, x, y = truth.pop(key)
            assert seen["value"]["id_feat"] == index
            assert np.allclose(seen["value"]["x"], [x - 0.5, y - 0.5], atol=EXACT_PX)
            assert np.allclose(projected, seen["value"]["x"], atol=EXACT_PX)
    assert not truth


def test_openmvg_names_every_type_once_and_numbers_every_object():
    """Cereal: the first occurrence of an id has its highest bit set and carries the content."""
    kinds = ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "SIMPLE_PINHOLE", "SIMPLE_RADIAL"]
    models = [
        camera(kind, k, [800.0 + k, *CAMERAS[kind][1:]]) for k, kind in enumerate(kinds, start=1)
    ]
    model = exact_model(models)
    cameras = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    record = sfm_data(cameras, model, None)
    values = [each["value"] for each in record["intrinsics"]]
    assert [v.get("polymorphic_name") for v in values] == [
        "pinhole", "pinhole_radial_k1", None, None,
    ]  # fmt: skip
    assert [v["polymorphic_id"] for v in values] == [2**31 + 1, 2**31 + 2, 1, 2]
    views = [each["value"] for each in record["views"]]
    assert all(v["polymorphic_id"] == 2**30 for v in views)
    ids = [v["ptr_wrapper"]["id"] for v in [*views, *values]]
    assert len(set(ids)) == 8 and all(i > 2**31 for i in ids)


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
                _, *seen = truth.pop((name, int(vertex["red"])))
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
@pytest.mark.parametrize("to", ["bundler", "nvm", "openmvg", "nerfstudio"])
def test_a_camera_that_a_format_lacks_is_refused_by_name(tmp_path, kind, to):
    params = pycolmap_params(kind)
    with pytest.raises(UserError, match=f"--to {to}: .*{kind}"):
        write(to, tmp_path, exact_model([camera(kind, 1, params)]))


@pytest.mark.parametrize(
    ("to", "kind", "params"),
    [
        ("bundler", "PINHOLE", [900.0, 950, 512, 384]),
        ("bundler", "SIMPLE_PINHOLE", [900.0, 512, 390]),
        ("bundler", "OPENCV", [900.0, 900, 512, 384, 0, 0, 0.01, 0]),
        ("bundler", "SIMPLE_RADIAL_FISHEYE", CAMERAS["SIMPLE_RADIAL_FISHEYE"]),
        ("nvm", "OPENCV", [900.0, 900, 512, 384, 0, 0, 0.01, 0]),
        ("nvm", "SIMPLE_RADIAL", [900.0, 512, 384, -0.4]),
        ("openmvg", "PINHOLE", [900.0, 950, 512, 384]),
    ],
)
def test_what_a_format_cannot_express_is_refused(tmp_path, to, kind, params):
    with pytest.raises(UserError, match=f"--to {to}: .*{kind}"):
        write(to, tmp_path, exact_model([camera(kind, 1, params)]))


def test_cameras_of_their_own_need_what_a_shared_one_does_not():
    """NVM's first line tells one camera's principal point, not two."""
    model = exact_model([camera("PINHOLE"), camera("PINHOLE", 2)])
    with pytest.raises(UserError, match="--to nvm: .*PINHOLE"):
        nvm_text(model)


def test_perspective_and_fisheye_together_are_refused(tmp_path):
    model = exact_model([camera("PINHOLE"), camera("OPENCV_FISHEYE", 2)])
    with pytest.raises(UserError, match="OPENCV_FISHEYE, PINHOLE"):
        write_nerfstudio(tmp_path, model, None)


def pycolmap_params(kind):
    import pycolmap

    made = pycolmap.Camera.create_from_model_name(1, kind, 900.0, *SIZE)
    return [*made.params]


def write(to, folder, model):
    if to == "bundler":
        write_bundler(folder, model)
    elif to == "nvm":
        nvm_text(model)
    elif to == "openmvg":
        sfm_data({i.name: model.camera(i.camera_id) for i in model.images.values()}, model, None)
    else:
        write_nerfstudio(folder, model, None)
