"""A data set that the tests of several benchmarks share."""

import shutil

import pytest


@pytest.fixture(scope="session")
def strecha(scene, tmp_path_factory):
    """The folder of one Strecha set: room/images with K.txt, and room/gt_dense_cameras."""
    folder = tmp_path_factory.mktemp("sets")
    shutil.copytree(scene / "images", folder / "room" / "images")
    shutil.copy(scene / "K.txt", folder / "room" / "images" / "K.txt")
    shutil.copytree(scene / "reference", folder / "room" / "gt_dense_cameras")
    return folder
