"""Sets that several benchmarks' tests share."""

import shutil

import pytest


@pytest.fixture(scope="session")
def strecha(scene, tmp_path_factory):
    """One set: SET/images with K.txt, SET/gt_dense_cameras."""
    folder = tmp_path_factory.mktemp("sets")
    shutil.copytree(scene / "images", folder / "room" / "images")
    shutil.copy(scene / "K.txt", folder / "room" / "images" / "K.txt")
    shutil.copytree(scene / "reference", folder / "room" / "gt_dense_cameras")
    return folder
