"""Laws of the poses of panoramas, and of their table."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsfm.colmap.panorama_poses import (
    COLUMNS,
    NOTE,
    panorama_poses,
    read_panorama_table,
    write_panorama_table,
)
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.core.panorama import Direction, ViewSet, panorama_pixels
from jaxsfm.errors import UserError

VIEWS = ViewSet((Direction(0, 0), Direction(60, 0), Direction(-120, 30)), 90.0)


def drawn(seed: int) -> CameraPose:
    rng = np.random.default_rng(seed)
    return CameraPose(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))


def same(one: CameraPose, other: CameraPose, atol=1e-9) -> None:
    np.testing.assert_allclose(one.rotation, other.rotation, atol=atol)
    np.testing.assert_allclose(one.centre, other.centre, atol=atol)


def test_each_view_says_the_pose_of_its_panorama():
    wanted = {"a.jpg": drawn(1), "b.jpg": drawn(2)}
    poses, view_of = {"c.jpg": drawn(3)}, {}
    for number, turn in enumerate(VIEWS.rotations()):
        for name, pose in wanted.items():
            view_of[f"{number}/{name}"] = (name, number)
            if (number, name) != (0, "b.jpg"):  # this view has no pose
                poses[f"{number}/{name}"] = CameraPose(turn @ pose.rotation, pose.centre)
    found = panorama_poses(poses, VIEWS, view_of)
    assert [*found] == ["a.jpg", "b.jpg"]
    for name, pose in found.items():
        same(pose, wanted[name])


def test_views_that_differ_are_averaged_to_a_rotation():
    turns = VIEWS.rotations()
    poses = {
        str(k): CameraPose(turns[k] @ Rotation.from_euler("y", a, degrees=True).as_matrix(), c)
        for k, (a, c) in enumerate(((-2.0, np.zeros(3)), (2.0, np.asarray([2.0, 0, 0]))))
    }
    found = panorama_poses(poses, VIEWS, {"0": ("p", 0), "1": ("p", 1)})
    same(found["p"], CameraPose(np.eye(3), np.asarray([1.0, 0, 0])))


def test_the_table_gives_back_what_was_written(tmp_path):
    models = [{"a, b.jpg": drawn(1), "ü/c.jpg": drawn(2)}, {"d.jpg": drawn(3)}]
    write_panorama_table(tmp_path / "t.csv", models)
    found = read_panorama_table(tmp_path / "t.csv")
    assert [[*each] for each in found] == [[*each] for each in models]
    for one, other in zip(found, models, strict=True):
        for name in one:
            same(one[name], other[name])


def test_the_table_says_which_pixel_shows_a_point():
    """The formulas of its note are those of the core, but for the origin of the pixels."""
    width, height = 4000, 2000
    for dx, dy, dz in np.random.default_rng(0).normal(size=(20, 3)):
        u, v = (
            eval(
                re.search(rf"{name} = (.*?)(?:, v|,\n)", NOTE)[1].replace("2 pi", "2 * pi"),
                {
                    "width": width,
                    "height": height,
                    "pi": np.pi,
                    "atan2": np.arctan2,
                    "hypot": np.hypot,
                    "dx": dx,
                    "dy": dy,
                    "dz": dz,
                },
            )
            for name in "uv"
        )
        at = panorama_pixels(np.asarray([dx, dy, dz]), (width, height))
        np.testing.assert_allclose(at + 0.5, [u, v], atol=1e-9)


@pytest.mark.parametrize(
    "bad", ["a,0,1,2", "a,0,1,2,3,x,0,0,0", "a,-1,1,2,3,1,0,0,0", "a,9999999,1"]
)
def test_what_is_no_table_is_named(tmp_path, bad):
    path = tmp_path / "t.csv"
    path.write_text(",".join(COLUMNS) + f"\n{bad}\n", encoding="utf-8")
    with pytest.raises(UserError, match="not a table of panoramas"):
        read_panorama_table(path)
