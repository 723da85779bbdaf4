"""A scene that the tests of the COLMAP adapter share."""

from typing import NamedTuple

import pycolmap
import pytest
from foreign_model import results_of

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult

SIZE = (1024, 768)
KNOWN = Intrinsics(model="PINHOLE", params=(1280.0, 1280.0, 512.0, 384.0))
NAMES = ["a b.png", "b\tc.png", "new\nline.png", "sub/日本.png", "z.png"]


class Scene(NamedTuple):
    """Five exact views of 150 points. The images have odd names, and their files do not exist."""

    truth: pycolmap.Reconstruction
    names: list[str]
    images: list[ImageFile]
    results: dict[Pair, PairResult]
    """The points that both images of each pair see; a cell is the point's number."""
    cameras: Cameras


def _truth() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_frames_per_rig=len(NAMES),
        num_points3D=150,
        num_points2D_without_point3D=0,
        camera_model_id=pycolmap.CameraModelId.PINHOLE,
        camera_params=list(KNOWN.params),
    )
    model = pycolmap.synthesize_dataset(options)
    for image_id, name in zip(sorted(model.reg_image_ids()), NAMES, strict=True):
        model.image(image_id).name = name
    return model


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Scene:
    nowhere = tmp_path_factory.mktemp("images")
    images = [ImageFile(name=n, path=nowhere / n, size=SIZE, sha256=64 * "0") for n in NAMES]
    truth = _truth()
    return Scene(truth, NAMES, images, results_of(truth), Cameras(known=KNOWN))
