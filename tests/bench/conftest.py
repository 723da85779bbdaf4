"""Data sets that the tests of several benchmarks share."""

import shutil

import numpy as np
import pytest


@pytest.fixture(scope="session")
def strecha(scene, tmp_path_factory):
    """The folder of one Strecha set: room/images with K.txt, and room/gt_dense_cameras."""
    folder = tmp_path_factory.mktemp("sets")
    shutil.copytree(scene / "images", folder / "room" / "images")
    shutil.copy(scene / "K.txt", folder / "room" / "images" / "K.txt")
    shutil.copytree(scene / "reference", folder / "room" / "gt_dense_cameras")
    return folder


@pytest.fixture(scope="session")
def simple(tmp_path_factory):
    """Four day views and a night view of the room, rendered."""
    from jaxsfm.bench.synthetic import camera_matrix, write_scene

    source = tmp_path_factory.mktemp("rendered")
    write_scene(source, num_views=5, size=(320, 240))
    folder = tmp_path_factory.mktemp("simple") / "room"
    for part in ("day", "night"):
        (folder / part).mkdir(parents=True)
    for path in (source / "images").iterdir():
        shutil.copy(path, folder / ("night" if "night" in path.name else "day") / path.name)
    shutil.copytree(source / "reference", folder / "reference")
    k = camera_matrix((320, 240))
    (folder / "intrinsics.txt").write_text(
        f"PINHOLE:{k[0, 0]},{k[1, 1]},{k[0, 2] + 0.5},{k[1, 2] + 0.5}\n"
    )
    return folder.parent


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """Eleven photos of a street."""
    from jaxsfm.bench.long_street import write_street

    folder = tmp_path_factory.mktemp("street")
    write_street(folder, 11)
    return folder


@pytest.fixture(scope="session")
def street_sequence(street, tmp_path_factory):
    """The same street as a sequence of 7-Scenes."""
    from jaxsfm.colmap.poses import read_poses

    folder = tmp_path_factory.mktemp("sequence") / "frames"
    folder.mkdir()
    for name, pose in read_poses(street / "reference").items():
        stem = name.removesuffix(".png")
        shutil.copy(street / "images" / name, folder)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation.T, pose.centre
        np.savetxt(folder / f"{stem}.pose.txt", matrix)
    shutil.copy(street / "K.txt", folder)
    return folder
