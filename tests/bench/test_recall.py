"""Laws of how many true pairs are among the partners of photos."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from room_scene import camera

from jaxsfm.bench import recall
from jaxsfm.bench.options import RecallOptions
from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.cli.main import main
from jaxsfm.colmap.view import View
from jaxsfm.io.pairs import exhaustive_pairs
from jaxsfm.io.pixels import Pixels
from jaxsfm.matching.retrieval import CANDIDATES

SIZE = (90, 60)


def placed(centre, turn=(1.0, 1.0, 1.0)) -> View:
    """A view at a place, that looks along the third axis, or against it."""
    view = View.without_pose("a", 0, camera(SIZE), SIZE, Pixels((1.0, 1.0)))
    return dataclasses.replace(view, rotation=np.diag(turn), centre=np.array(centre))


AHEAD = placed([0.0, 0.0, 0.0])


def aside(share, depth) -> View:
    """A view of the rest of what AHEAD sees, moved by a share of its width."""
    return placed([share * SIZE[0] * depth / camera_matrix(SIZE)[0, 0], 0.0, 0.0])


@pytest.mark.parametrize(("share", "columns"), [(0.0, 9), (0.3, 6), (0.6, 4), (1.2, 0)])
def test_a_camera_moved_by_a_share_of_the_width_sees_the_rest(share, columns):
    """Of nine columns of rays that are evenly spread over the photo, some are lost."""
    depth = 3.0
    seen = recall.seen_share(AHEAD, aside(share, depth), depth)
    assert seen == pytest.approx(columns / 9)


def test_what_lies_behind_a_camera_is_not_seen():
    turned = placed([0.0, 0.0, 0.0], (-1.0, 1.0, -1.0))
    assert recall.seen_share(AHEAD, turned, 2.0) == 0.0


def test_by_poses_both_cameras_of_a_true_pair_see_half_of_the_other():
    """A camera that stands far behind sees all of the other, but the other little of it."""
    behind = placed([0.0, 0.0, -8.0])
    views = {"a": AHEAD, "b": aside(0.3, 2.0), "c": aside(0.7, 2.0), "d": behind}
    assert recall.pairs_by_poses(views, 2.0) == {("a", "b"), ("b", "c")}
    assert recall.seen_share(AHEAD, behind, 2.0) == 1.0
    with_more_of_it_in_sight = recall.pairs_by_poses(views, 200.0)
    assert ("a", "d") in with_more_of_it_in_sight


def test_by_a_model_true_pairs_have_enough_points_in_common(tmp_path):
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[9, 9, 4, 4], camera_id=1)
    )
    for k, name in enumerate("abc", 1):
        photo = pycolmap.Image(name=f"{name}.png", camera_id=1, image_id=k)
        photo.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.ones(2))] * 8)
        model.add_image_with_trivial_frame(photo, pycolmap.Rigid3d())
    for point in range(8):
        track = pycolmap.Track()
        for k in (1, 2, 3)[: 3 if point < 5 else 2]:
            track.add_element(k, point)
        model.add_point3D(np.array([0.0, 0.0, 3.0]), track)
    model.write(tmp_path)
    assert recall.pairs_by_model(tmp_path, 6) == {("a.png", "b.png")}
    assert len(recall.pairs_by_model(tmp_path, 5)) == 3
    assert not recall.pairs_by_model(tmp_path)


def test_a_photo_is_connected_by_five_true_partners_or_by_all_that_it_has():
    true = {("a", name) for name in "bcdefgh"}
    tried = {("a", name) for name in "bcdef"} | {("b", "c"), ("g", "h")}
    assert recall.found_pairs(tried, true)[:3] == (7, 5, 6)
    assert recall.found_pairs(tried - {("a", "f")}, true)[:3] == (6, 4, 4)


def test_errors_add_up_along_a_chain_and_little_if_all_pairs_are_tried():
    chain = {(f"{k}", f"{k + 1}") for k in range(8)}
    assert recall.mean_resistance(chain) == (9, pytest.approx(10 / 3))
    assert recall.mean_resistance(set(exhaustive_pairs("abcdef"))) == (6, pytest.approx(2 / 6))
    assert recall.mean_resistance({("a", "b"), ("c", "d"), ("d", "e")}) == (3, pytest.approx(4 / 3))
    assert recall.mean_resistance(set()) == (0, 0.0)


@pytest.mark.slow
def test_strangers_are_counted_apart(street_sequence, tmp_path, capsys):
    """Of the pairs of a street with two photos of itself as strangers, the true ones are found."""
    strangers = tmp_path / "others"
    strangers.mkdir()
    for name in ("photo00000.png", "photo00001.png"):
        (strangers / name).write_bytes((street_sequence / name).read_bytes() + b" ")
    figures = tmp_path / "figures.json"
    options = [
        "--truth",
        str(street_sequence),
        "--depth",
        "8",
        "--partners",
        "2,20",
        "--candidates",
        "1",
    ]
    given = ["bench", "recall", "--root", str(street_sequence), "--strangers", str(strangers)]
    given += [*options, "--json", str(figures), "--methods", "vlad"]
    assert main(given) == 0
    assert "11 of 11" in capsys.readouterr().out
    few, every = json.loads(figures.read_text())["rows"]
    assert every["pairs"] == 13 * 12 // 2 and every["among_own"] == 11 * 10 // 2
    assert every["true"] == every["of"] > 9 and every["connected"] == every["photos"] == 11
    assert 0 < few["true"] <= few["among_own"] < few["pairs"] < every["pairs"]


def test_the_default_is_what_reconstruct_does():
    assert RecallOptions(root=Path(), truth=Path()).candidates == (str(CANDIDATES),)


def test_a_truth_that_is_none_is_refused(street_sequence, tmp_path, capsys):
    given = ["bench", "recall", "--root", str(street_sequence)]
    assert main([*given, "--truth", str(tmp_path)]) == 2
    assert "no COLMAP model" in capsys.readouterr().err
    assert main([*given, "--truth", str(tmp_path), "--depth", "0"]) == 2
    assert "--depth must be more than 0; got 0" in capsys.readouterr().err
