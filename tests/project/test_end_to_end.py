"""Real or rendered photos in, cameras out, against exact or measured truth."""

import itertools

import numpy as np
import pytest

import jaxsfm
from jaxsfm.config import MIN_SIDE
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.view_graph import rotation_angle_deg


@pytest.mark.slow
def test_a_dozen_lines_of_python_do_the_same_as_the_command(tmp_path):
    from jaxsfm.bench.synthetic import camera_matrix, write_scene

    truth = write_scene(tmp_path, num_views=4, size=(320, 240))
    np.savetxt(tmp_path / "K.txt", camera_matrix((320, 240)))

    config = jaxsfm.preset("paper")
    weights = jaxsfm.load_weights()
    images, _ = jaxsfm.open_images(tmp_path / "images")
    features = jaxsfm.extract(weights, images, config=config)
    matches = jaxsfm.match(features, jaxsfm.exhaustive_pairs(features), config=config)
    made = jaxsfm.reconstruct(
        images,
        matches,
        tmp_path / "database.db",
        config=config,
        cameras=jaxsfm.Cameras(known=jaxsfm.parse_intrinsics(str(tmp_path / "K.txt"))),
    )
    errors = jaxsfm.evaluate(jaxsfm.model_poses(made.models[0]), truth)
    assert len(errors.images) == 4
    # 320 x 240: one working pixel is 1/320 of a focal length, 0.015 units at the room's distance.
    assert errors.position["mean"] < 0.1 and errors.rotation_deg["mean"] < 1.0

    # Any order of any subset of the pairs gives the same matches, bit for bit.
    pair = max(matches)
    alone = jaxsfm.match(features, [pair[::-1]], config=config)
    for field in ("cells", "keypoints0", "plane", "homographies"):
        np.testing.assert_array_equal(getattr(alone[pair], field), getattr(matches[pair], field))


@pytest.mark.slow
def test_strecha_cameras_are_recovered_at_half_size(data_folder, tmp_path):
    """A quick look at real photos; docs/results.md has the full-size figures of all sets.

    Rotations are compared between cameras: these four stand within 0.3 of 4 m of one line, so that
    an alignment of their centres turns errors of 5 mm into a degree about it (with seeds 0 .. 7
    0.1-0.7 deg after the alignment, 0.1-0.2 deg between cameras).
    """
    names = ("0003", "0004", "0005", "0006")
    folder = data_folder / "strecha" / "fountain-P11"
    images = [i for i in jaxsfm.open_images(folder / "images")[0] if i.name[:4] in names]
    config = jaxsfm.Config(max_size=768, pair=jaxsfm.preset("paper").pair)
    features = jaxsfm.extract(jaxsfm.load_weights(), images, config=config)
    matches = jaxsfm.match(features, jaxsfm.exhaustive_pairs(features), config=config)
    made = jaxsfm.reconstruct(
        images,
        matches,
        tmp_path / "database.db",
        config=config,
        cameras=jaxsfm.Cameras(known=jaxsfm.parse_intrinsics(str(folder / "images" / "K.txt"))),
    )
    poses, truth = jaxsfm.model_poses(made.models[0]), jaxsfm.read_poses(folder)
    assert {name[:4] for name in poses} == set(names)
    assert evaluate(poses, truth).position["max"] < 0.05
    for a, b in itertools.combinations(sorted(poses), 2):
        ours, measured = (p[b].rotation @ p[a].rotation.T for p in (poses, truth))
        assert rotation_angle_deg(ours, measured) < 0.5


def test_configs_refuse_what_makes_no_sense():
    for wrong in (
        {"max_size": MIN_SIDE - 1},
        {"keypoints": "corners"},
        {"threshold_px": 0.0},
        {"min_inliers": 3},
        {"confidence": 1.0},
    ):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            jaxsfm.Config(**wrong)
    with pytest.raises(ValueError, match="max_planes"):
        jaxsfm.PairShape(max_planes=0)
    with pytest.raises(ValueError, match="paper"):
        jaxsfm.preset("nature")
