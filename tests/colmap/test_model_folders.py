"""COLMAP models: their order, their files, the colours of their points."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from mapped import map_database

from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_folders import colour_points, write_models
from jaxsfm.colmap.poses import model_poses
from jaxsfm.io.images import WorkingImage

ONE = MapOptions(refine_intrinsics=False, threads=1)


def test_written_models_replace_all_that_was_there(tmp_path, scene):
    smaller = pycolmap.Reconstruction(scene.truth)
    smaller.deregister_frame(min(smaller.reg_frame_ids()))
    folder = tmp_path / "sparse"
    (folder / "2").mkdir(parents=True)
    (folder / "2" / "stale.bin").write_text("x")
    write_models([scene.truth, smaller], folder)
    assert sorted(path.name for path in folder.iterdir()) == ["0", "1"]
    sizes = [pycolmap.Reconstruction(folder / str(i)).num_reg_images() for i in (0, 1)]
    assert sizes == [len(scene.names), len(scene.names) - 1]
    write_models([smaller], folder)
    assert [path.name for path in folder.iterdir()] == ["0"]
    write_models([], folder)
    assert not folder.exists()


def test_two_scenes_give_two_models_the_larger_first(tmp_path, scene):
    small = [dataclasses.replace(i, name=f"s{k}.png") for k, i in enumerate(scene.images[:3])]
    other = {
        (f"s{i}.png", f"s{j}.png"): dataclasses.replace(
            scene.results[scene.names[i], scene.names[j]], pair=(f"s{i}.png", f"s{j}.png")
        )
        for i, j in ((0, 1), (0, 2), (1, 2))
    }
    write_database(tmp_path / "d.db", small + scene.images, scene.results | other, scene.cameras)
    models = map_database(tmp_path / "d.db", ONE)
    assert [sorted(model_poses(m)) for m in models] == [scene.names, [i.name for i in small]]


@pytest.mark.parametrize("scale", [(1.0, 1.0), (2.0, 1.5)])
def test_a_point_has_the_colour_of_the_pixels_under_it(scene, scale):
    """Every image is black but for the pixels of its observations."""
    width, height = (round(side / s) for side, s in zip(scene.images[0].size, scale, strict=True))
    photos = {name: np.zeros((height, width, 3), np.uint8) for name in scene.names}
    lone = {}
    for index, image in enumerate(scene.truth.images.values()):
        pixels = {}
        for point in image.points2D:
            x, y = (int(c / s) for c, s in zip(point.xy, scale, strict=True))
            pixels.setdefault((x, y), []).append(point.point3D_id)
        for (x, y), ids in pixels.items():
            photos[image.name][y, x] = (ids[0] % 256, 40, 50 + 10 * index)
            for shared in ids if len(ids) > 1 else ():
                lone[shared] = False  # two points on one pixel
    model = pycolmap.Reconstruction(scene.truth)
    colour_points(model, lambda name: WorkingImage(photos[name], scale))
    checked = [p for p in model.points3D if lone.get(p, True)]
    assert len(checked) > 100
    for point_id in checked:
        assert tuple(model.point3D(point_id).color) == (point_id % 256, 40, 70)
