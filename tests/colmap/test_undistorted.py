"""Undistorted photos show what a camera without distortion would, where the model says so."""

import shutil
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import pytest
from foreign_model import CAMERAS, NAMES, camera, exact_model
from room_scene import hidden

from jaxsfm.bench.synthetic import arc, camera_matrix, render, room, write_photo
from jaxsfm.colmap.formats.undistorted import READABLE, write_undistorted
from jaxsfm.colmap.model_files import read_model
from jaxsfm.errors import UserError

TEXTURE = cv2.resize(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8), (1024, 768))
"""A photo of the size of `foreign_model`'s cameras."""


def written(folder, model, image=TEXTURE):
    """A model and a photo for each of its images; the folders of both."""
    models, photos = folder / "model", folder / "photos"
    models.mkdir(parents=True)
    photos.mkdir()
    model.write_binary(models)
    for each in model.images.values():
        (photos / each.name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(photos / each.name), image)
    return models, photos


def undistorted(folder, models, photos, max_size=-1):
    """The model of the new photos, whose folder is `folder`/dense."""
    dense = folder / "dense"
    dense.mkdir()
    write_undistorted(dense, models, read_model(models), photos, max_size)
    return pycolmap.Reconstruction(dense / "sparse")


def refused(folder, models, photos) -> str:
    with pytest.raises(UserError) as error:
        undistorted(folder, models, photos)
    shutil.rmtree(folder / "dense")
    return str(error.value)


def size_of(path):
    return cv2.imread(str(path), cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_COLOR).shape[1::-1]


@pytest.mark.parametrize("max_size", [-1, 700])
def test_keypoints_are_the_projections_of_their_points_without_distortion(tmp_path, max_size):
    """All kinds of cameras in one model; the photos lie in sub-folders."""
    kinds = sorted(CAMERAS)
    names = [f"{kind}/a.jpg" for kind in kinds]
    model = exact_model([camera(kind, k + 1) for k, kind in enumerate(kinds)], names)
    new = undistorted(tmp_path, *written(tmp_path, model), max_size)
    assert sorted(image.name for image in new.images.values()) == names
    assert new.num_points3D() == model.num_points3D()
    for image_id, image in new.images.items():
        old, own = model.image(image_id), new.camera(image.camera_id)
        *focal, cx, cy = own.params
        fx, fy = focal[0], focal[-1]
        assert own.model_name in ("PINHOLE", "SIMPLE_PINHOLE")
        assert size_of(tmp_path / "dense" / "images" / image.name) == (own.width, own.height)
        assert max_size == -1 or max(own.width, own.height) == max_size
        pose = image.cam_from_world()
        assert np.allclose(pose.matrix(), old.cam_from_world().matrix(), atol=1e-12)
        observed = 0
        for point, former in zip(image.points2D, old.points2D, strict=True):
            assert point.point3D_id == former.point3D_id
            if point.has_point3D():
                x, y, z = pose * new.point3D(point.point3D_id).xyz
                # COLMAP removes the distortion by iteration.
                assert np.allclose(point.xy, (fx * x / z + cx, fy * y / z + cy), atol=1e-4)
                observed += 1
        assert observed > 30


def test_a_camera_without_distortion_keeps_its_photo_and_its_numbers(tmp_path):
    model = exact_model([camera("PINHOLE"), camera("OPENCV", 2)])
    models, photos = written(tmp_path, model)
    new = undistorted(tmp_path, models, photos)
    kept = [image.name for image in model.images.values() if image.camera_id == 1]
    assert np.array_equal(new.camera(1).params, model.camera(1).params) and len(kept) == 1
    for name in NAMES:
        same = (tmp_path / "dense/images" / name).read_bytes() == (photos / name).read_bytes()
        assert same == (name in kept)


def test_the_folder_is_a_dense_workspace_that_splatting_reads_too(tmp_path):
    undistorted(tmp_path, *written(tmp_path, exact_model([camera("SIMPLE_RADIAL")])))
    dense = tmp_path / "dense"
    lines = (dense / "stereo" / "patch-match.cfg").read_text().split("\n")
    assert lines[::2][: len(NAMES)] == sorted(NAMES) and lines[1].startswith("__auto__")
    assert (dense / "stereo" / "fusion.cfg").read_text().split() == sorted(NAMES)
    for maps in ("depth_maps", "normal_maps", "consistency_graphs"):
        for name in NAMES:
            assert (dense / "stereo" / maps / name).parent.is_dir()
    for file in ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"):
        assert (dense / "sparse/0" / file).read_bytes() == (dense / "sparse" / file).read_bytes()


def test_images_without_a_pose_are_left_out_and_need_no_photo(tmp_path):
    model = exact_model([camera("OPENCV")])
    model.deregister_frame(model.image(2).frame_id)
    models, photos = written(tmp_path, model)
    (photos / NAMES[1]).unlink()
    new = undistorted(tmp_path, models, photos)
    left = sorted({*NAMES} - {NAMES[1]})
    assert sorted(image.name for image in new.images.values()) == left
    assert (tmp_path / "dense/stereo/fusion.cfg").read_text().split() == left


def test_an_empty_model_gives_an_empty_workspace(tmp_path):
    new = undistorted(tmp_path, *written(tmp_path, pycolmap.Reconstruction()))
    assert new.num_images() == 0 and (tmp_path / "dense/stereo/fusion.cfg").read_text() == ""


@pytest.mark.parametrize("suffix", sorted(READABLE))
@pytest.mark.parametrize("kind", ["OPENCV", "PINHOLE"])
def test_formats_that_are_said_to_be_readable_are(tmp_path, suffix, kind):
    names = [f"{n}{suffix}" for n in "ab"]
    image = TEXTURE[::16, ::16, 0] if suffix == ".pgm" else TEXTURE[::16, ::16]
    params = [x / 16 for x in CAMERAS[kind][:4]] + CAMERAS[kind][4:]
    model = exact_model([camera(kind)], names)
    model.camera(1).width, model.camera(1).height = 64, 48
    model.camera(1).params = params
    new = undistorted(tmp_path, *written(tmp_path, model, image))
    for name in names:
        own = new.camera(1)
        assert size_of(tmp_path / "dense" / "images" / name) == (own.width, own.height)


@pytest.mark.parametrize("kind", ["OPENCV", "PINHOLE"])
def test_photos_that_cannot_be_undistorted_are_named(tmp_path, kind):
    """COLMAP leaves such photos out, or writes half of one, and raises no error."""
    models, photos = written(tmp_path, exact_model([camera(kind)]))
    whole = {name: (photos / name).read_bytes() for name in NAMES}
    for name in (NAMES[1], NAMES[2]):  # a JPEG and a PNG
        (photos / name).unlink()
        assert f"no {name} in it" in refused(tmp_path, models, photos)
        for data in (b"", b"text", whole[name][: len(whole[name]) // 2]):
            (photos / name).write_bytes(data)
            assert name in refused(tmp_path, models, photos)
        write_photo(photos / name, TEXTURE[:500])
        message = refused(tmp_path, models, photos)
        assert f"{name}: the photo has 1024 x 500 pixels, but its camera 1024 x 768" in message
        (photos / name).write_bytes(whole[name])
    undistorted(tmp_path, models, photos)


@pytest.mark.parametrize("suffix", [".webp", ".jp2", ""])
def test_formats_that_colmap_does_not_read_are_refused(tmp_path, suffix):
    """COLMAP would leave out the photo, and keep its image in the model."""
    model = exact_model([camera("OPENCV")])
    models, photos = written(tmp_path, model)
    name = f"photo{suffix}"
    model.image(1).name = name
    model.write_binary(models)
    write_photo(photos / f"photo{suffix or '.jpg'}", TEXTURE)
    (photos / f"photo{suffix or '.jpg'}").rename(photos / name)
    message = refused(tmp_path, models, photos)
    assert message.startswith(f"{name}: COLMAP does not read") and ".jpg" in message


def test_a_camera_that_no_pinhole_camera_can_replace_is_refused(tmp_path):
    model = exact_model([camera("OPENCV")])
    whole = pycolmap.Camera.create_from_model_id(
        1, pycolmap.CameraModelId.EQUIRECTANGULAR, 1.0, 1024, 768
    )
    model.camera(1).model, model.camera(1).params = whole.model, whole.params
    models, photos = written(tmp_path, model)
    assert "camera of model EQUIRECTANGULAR" in refused(tmp_path, models, photos)


@pytest.mark.parametrize(
    "name", ["../out.jpg", "/tmp/out.jpg", "new\nline.jpg", " a.jpg", "#a.jpg"]
)
def test_names_that_lead_out_or_that_colmaps_lists_cannot_hold_are_refused(tmp_path, name):
    model = exact_model([camera("OPENCV")])
    models, photos = written(tmp_path, model)
    model.image(1).name = name
    model.write_binary(models)
    message = refused(tmp_path, models, photos)
    assert "outside the photos' folder" in message or "cannot hold the name" in message
    assert not (tmp_path / "out.jpg").exists()


LENS = [260.0, 250.0, 150.0, 125.0, -0.22, 0.05, 0.003, -0.002]
"""An OPENCV camera of 320 x 240 pixels, in COLMAP's pixels. It moves the corners by 25 pixels."""
SIZE, LARGE = (320, 240), (720, 540)
"""(width, height) of the photos, and of the sharp images from which they are made."""


class DistortedRoom(NamedTuple):
    """Photos of the rendered room through a lens, and what `write_undistorted` makes of them."""

    folder: Path
    model: pycolmap.Reconstruction
    """The model of the undistorted photos."""
    sharp: dict[str, np.ndarray]
    """The same views through a pinhole camera, uint8 RGB (`LARGE`)."""

    def without_lens(self, name: str) -> np.ndarray:
        """The picture that an undistorted photo should be, resampled from the sharp one."""
        own = self.model.camera(1)
        x, y = np.meshgrid(np.arange(own.width) + 0.5, np.arange(own.height) + 0.5)
        fx, fy, cx, cy = own.params
        return _resampled(self.sharp[name], np.stack([(x - cx) / fx, (y - cy) / fy], axis=-1))


def _resampled(sharp: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Colours of a sharp image along rays, (..., x / z and y / z)."""
    k = camera_matrix(LARGE)
    maps = (rays * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]]).astype(np.float32)
    smooth = cv2.GaussianBlur(sharp, (0, 0), 0.8)  # the photo has fewer pixels
    return cv2.remap(smooth, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)


@pytest.fixture(scope="module")
def distorted(tmp_path_factory) -> DistortedRoom:
    """OpenCV, and not COLMAP, applies and removes the distortion of the photos and the points."""
    folder = tmp_path_factory.mktemp("room")
    planes, poses = room(), arc(4)
    fx, fy, cx, cy, *terms = LENS
    k, terms = np.asarray([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), np.asarray(terms)
    x, y = np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1])))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, k, terms, criteria=criteria).reshape(*x.shape, 2)
    rng = np.random.default_rng(0)
    parts = [
        p.corner + rng.random((60, 1)) * p.right + rng.random((60, 1)) * p.down for p in planes
    ]
    points, plane = np.concatenate(parts), np.repeat(np.arange(len(planes)), 60)
    tracks = [pycolmap.Track() for _ in points]
    sharp, model = {}, pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model="OPENCV", width=SIZE[0], height=SIZE[1], params=LENS)
    model.add_camera_with_trivial_rig(lens)
    (folder / "photos").mkdir()
    for number, pose in enumerate(poses):
        name, shift = f"{number}.png", -pose.rotation @ pose.centre
        sharp[name] = render(planes, pose, LARGE)
        write_photo(folder / "photos" / name, _resampled(sharp[name], rays))
        xy, _ = cv2.projectPoints(points, cv2.Rodrigues(pose.rotation)[0], shift, k, terms)
        inside = ((xy[:, 0] > 0) & (xy[:, 0] < np.asarray(SIZE) - 1)).all(axis=1)
        seen = np.flatnonzero(inside & ~hidden(points, plane, pose.centre, planes))
        for place, point in enumerate(seen):
            tracks[point].add_element(number + 1, place)
        image = pycolmap.Image(
            name=name, camera_id=1, image_id=number + 1, keypoints=xy[seen, 0] + 0.5
        )
        placed = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), shift)
        model.add_image_with_trivial_frame(image, placed)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    return DistortedRoom(folder, undistorted(folder, folder / "model", folder / "photos"), sharp)


def test_a_photo_without_its_distortion_is_what_a_pinhole_camera_sees(distorted):
    for name in distorted.sharp:
        found = cv2.imread(str(distorted.folder / "dense/images" / name))[..., ::-1]
        wanted = distorted.without_lens(name)
        assert found.shape == wanted.shape
        assert (found.max(axis=2) == 0).mean() < 1.5 * (wanted.max(axis=2) == 0).mean() + 1e-3
        # Quarters of the photo, so that a wrong distortion cannot cancel itself.
        middle, half = np.asarray(found.shape[:2]) // 2, np.asarray(found.shape[:2]) // 2 - 6
        for corner in ((4, 4), (4, middle[1]), (middle[0], 4), tuple(middle)):
            part = tuple(slice(c, c + h) for c, h in zip(corner, half, strict=True))
            grays = [image[part].mean(axis=2) for image in (found, wanted)]
            window = cv2.createHanningWindow(tuple(half[::-1].tolist()), cv2.CV_64F)
            shift, _ = cv2.phaseCorrelate(*grays, window)
            assert np.abs(grays[0] - grays[1]).mean() < 6 and np.abs(shift).max() < 0.15


def _patch(image: np.ndarray, xy: np.ndarray, half: int = 6) -> np.ndarray:
    """A square patch around a point in COLMAP's pixels, with mean 0 and length 1."""
    x, y = xy - 0.5
    offsets = np.arange(-half, half + 1.0)
    grid = np.meshgrid(x + offsets, y + offsets)
    patch = cv2.remap(image, *(a.astype(np.float32) for a in grid), cv2.INTER_LINEAR)
    patch = patch.astype(float) - patch.mean()
    return patch / max(np.linalg.norm(patch), 1e-9)


def test_points_project_to_the_same_content_as_in_the_photos(distorted):
    """Patches around a point's projection with and without distortion look the same."""
    agreement, beside = [], []
    given = pycolmap.Reconstruction(distorted.folder / "model")
    for image_id, image in distorted.model.images.items():
        before, after = (
            cv2.imread(str(distorted.folder / sub / image.name), cv2.IMREAD_GRAYSCALE)
            for sub in ("photos", "dense/images")
        )
        for point, former in zip(image.points2D, given.image(image_id).points2D, strict=True):
            if not point.has_point3D() or (np.abs(former.xy - np.divide(SIZE, 2)) > 100).any():
                continue  # near the corners, distortion deforms a patch
            projected = image.project_point(distorted.model.point3D(point.point3D_id).xyz)
            patch = _patch(before, former.xy)
            agreement.append((patch * _patch(after, projected)).sum())
            beside.append((patch * _patch(after, projected + [3, 0])).sum())
    assert len(agreement) > 200
    assert np.median(agreement) > 0.98 > 0.9 > np.median(beside)


def _plane_maps(distorted: DistortedRoom, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Exact depths (h, w) and normals (h, w, 3) of a view, in its camera's coordinates.

    In COLMAP's fusion, the depth of a pixel belongs to the ray through its top-left corner.
    """
    (image,) = (image for image in distorted.model.images.values() if image.name == name)
    own, pose = distorted.model.camera(1), image.cam_from_world().matrix()
    fx, fy, cx, cy = own.params
    x, y = np.meshgrid(np.arange(own.width), np.arange(own.height))
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones(x.shape)], axis=-1)
    depth, normal = np.full(x.shape, np.inf), np.zeros((*x.shape, 3))
    for plane in room():
        corner = pose[:, :3] @ plane.corner + pose[:, 3]
        right, down = pose[:, :3] @ plane.right, pose[:, :3] @ plane.down
        up = np.cross(right, down)
        found = corner @ up / (rays @ up)
        offset = found[..., None] * rays - corner
        a, b = offset @ right / (right @ right), offset @ down / (down @ down)
        hit = (found > 0) & (found < depth) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        depth[hit], normal[hit] = found[hit], -np.sign(up @ corner) * up / np.linalg.norm(up)
    return np.where(np.isfinite(depth), depth, 0), normal


def _write_map(path: Path, values: np.ndarray) -> None:
    """COLMAP's depth and normal maps: the sizes as text, then float32, columns fastest."""
    values = values.reshape(*values.shape[:2], -1)
    rows, columns, channels = values.shape
    data = np.ascontiguousarray(values.transpose(2, 0, 1), np.float32).tobytes()
    path.write_bytes(f"{columns}&{rows}&{channels}&".encode() + data)


def test_colmap_fuses_exact_depths_of_the_workspace_into_the_scenes_surfaces(distorted, tmp_path):
    """COLMAP accepts the folder, and places its photos' colours where the scene has them."""
    dense = shutil.copytree(distorted.folder / "dense", tmp_path / "dense")
    for name in distorted.sharp:
        depth, normal = _plane_maps(distorted, name)
        for kind, values in (("depth_maps", depth), ("normal_maps", normal)):
            _write_map(dense / "stereo" / kind / f"{name}.geometric.bin", values)
    (tmp_path / "fused").mkdir()
    options = pycolmap.StereoFusionOptions(min_num_pixels=3)
    fused = pycolmap.stereo_fusion(tmp_path / "fused", dense, options=options)
    points = np.asarray([point.xyz for point in fused.points3D.values()])
    off = []
    for plane in room():
        normal = np.cross(plane.right, plane.down)
        off.append(np.abs((points - plane.corner) @ normal) / np.linalg.norm(normal))
    off = np.min(off, axis=0)
    assert len(points) > 20_000 and np.median(off) < 1e-5 and off.max() < 5e-3
    one = distorted.model.image(1)
    picture = distorted.without_lens(one.name)
    errors = []
    for point in list(fused.points3D.values())[::50]:
        xy = one.project_point(point.xyz)
        if xy is not None and ((xy > 1) & (xy < np.asarray(picture.shape[1::-1]) - 1)).all():
            errors.append(np.abs(picture[int(xy[1]), int(xy[0])].astype(int) - point.color).mean())
    assert len(errors) > 100 and np.median(errors) < 8
