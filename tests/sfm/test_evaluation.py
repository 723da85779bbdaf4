"""Errors of poses after the best similarity."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsfm.colmap.poses import CameraPose, Poses
from jaxsfm.errors import UserError
from jaxsfm.sfm.evaluation import (
    evaluate,
    of_photos,
    own_rotation_deg,
    pair_names,
    read_names,
    rotation_angle_deg,
)

law = settings(max_examples=25, deadline=None)


def turn(axis, degrees: float) -> np.ndarray:
    """Rotation matrix about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.radians(degrees)
    return np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k


def poses(n: int = 6, seed: int = 0) -> Poses:
    rng = np.random.default_rng(seed)
    return {
        f"{i}.jpg": CameraPose(turn(rng.normal(size=3), 360 * rng.random()), rng.normal(size=3))
        for i in range(n)
    }


def moved(reference: Poses, scale: float, rotation: np.ndarray, shift) -> Poses:
    """The same cameras in another frame: X' = scale * rotation X + shift."""
    return {
        name: CameraPose(pose.rotation @ rotation.T, scale * rotation @ pose.centre + shift)
        for name, pose in reference.items()
    }


vectors = st.tuples(*3 * [st.floats(-1, 1)])
axes = vectors.filter(lambda v: np.linalg.norm(v) > 0.1)
similarities = st.tuples(st.floats(-3, 3), axes, st.floats(-180, 180), vectors)


@law
@given(similarities, st.integers(0, 5))
def test_the_frame_of_the_model_does_not_matter(similarity, seed):
    log_scale, axis, degrees, shift = similarity
    truth = poses(seed=seed)
    model = moved(truth, 10**log_scale, turn(axis, degrees), 10 * np.asarray(shift))
    result = evaluate(model, truth)
    assert result.position["max"] < 1e-9 and result.rotation_deg["max"] < 1e-9
    assert set(result.within.values()) == {1.0} and result.aligned_on == 6


@law
@given(similarities, vectors, st.floats(1e-6, 179))
def test_one_wrong_camera_has_its_own_error_when_aligned_on_the_others(similarity, step, angle):
    log_scale, axis, degrees, shift = similarity
    truth, change = poses(), turn([1, 2, 3], angle)
    bad = dict(truth)
    bad["2.jpg"] = CameraPose(
        change @ truth["2.jpg"].rotation, truth["2.jpg"].centre + np.asarray(step)
    )
    model = moved(bad, 10**log_scale, turn(axis, degrees), shift)
    others = sorted(truth.keys() - {"2.jpg"})
    result = evaluate(model, truth, align_on=others)
    assert result.aligned_on == 5
    assert result.images["2.jpg"].position == pytest.approx(np.linalg.norm(step), abs=1e-9)
    assert result.images["2.jpg"].rotation_deg == pytest.approx(angle, abs=1e-9)
    assert max(result.images[name].position for name in others) < 1e-9


@law
@given(similarities, st.integers(0, 5))
def test_a_common_turn_of_all_cameras_is_no_own_rotation(similarity, seed):
    """Whatever the centres are."""
    log_scale, axis, degrees, shift = similarity
    truth = poses(seed=seed)
    turned = {
        name: CameraPose(pose.rotation, 10 * poses(seed=seed + 1)[name].centre)
        for name, pose in truth.items()
    }
    model = moved(turned, 10**log_scale, turn(axis, degrees), shift)
    assert own_rotation_deg(model, truth) < 1e-9
    assert evaluate(model, truth).rotation_deg["mean"] > 1


def test_own_rotations_are_the_deviations_from_the_common_turn():
    """Two cameras that turn by 3 deg one way and the other, beside four that do not."""
    truth = poses()
    model = dict(truth)
    for name, degrees in (("1.jpg", 3.0), ("4.jpg", -3.0)):
        pose = truth[name]
        model[name] = CameraPose(pose.rotation @ turn([1, 2, 3], degrees), pose.centre)
    assert own_rotation_deg(model, truth) == pytest.approx(1.0, abs=1e-9)
    with pytest.raises(UserError, match="no common images"):
        own_rotation_deg(model, {})


def test_units_are_those_of_the_reference():
    truth = moved(poses(), 1000, np.eye(3), 0)
    model = dict(truth)
    model["0.jpg"] = truth["0.jpg"]._replace(centre=truth["0.jpg"].centre + [3, 0, 4])
    model = moved(model, 0.001, np.eye(3), 1)
    result = evaluate(model, truth, align_on=[f"{i}.jpg" for i in range(1, 6)])
    assert result.position["max"] == pytest.approx(5)
    assert result.position["mean"] == pytest.approx(5 / 6)
    assert result.position["median"] == pytest.approx(0, abs=1e-9)


def test_shares_count_missing_and_turned_images_as_failures():
    truth = poses(8)
    names = sorted(truth)
    model = {name: truth[name] for name in names[:6]}
    far, near, turned = names[:3]
    model[far] = truth[far]._replace(centre=truth[far].centre + [7, 0, 0])
    model[near] = truth[near]._replace(centre=truth[near].centre + [0.6, 0, 0])
    model[turned] = truth[turned]._replace(rotation=turn([0, 0, 1], 11) @ truth[turned].rotation)
    result = evaluate(model, truth, align_on=names[3:6])
    assert result.missing == names[6:]
    assert result.within == {0.5: 3 / 8, 1.0: 4 / 8, 5.0: 4 / 8, 10.0: 5 / 8, 20.0: 5 / 8}
    figures = json.loads(json.dumps(result.as_dict()))
    assert (figures["registered"], figures["reference_images"]) == (6, 8)
    assert figures["within_10deg"]["0.5"] == 3 / 8 and figures["missing"] == names[6:]


def test_a_reference_of_more_photos_is_cut_to_those_that_were_given():
    truth = poses(8)
    names = sorted(truth)
    photos = [names[0], names[3].replace(".jpg", ".png"), "another.jpg"]
    assert set(of_photos(truth, photos)) == {names[0], names[3]}
    assert of_photos(truth, ["another.jpg"]) == {}


# -- what determines no alignment ------------------------------------------------------------------


def on_a_line(n: int = 5, off: float = 0.0) -> Poses:
    line = {f"{i}.jpg": CameraPose(np.eye(3), np.asarray([i, 2.0 * i, 3])) for i in range(n)}
    line["1.jpg"] = line["1.jpg"]._replace(centre=line["1.jpg"].centre + [0, 0, off])
    return line


@pytest.mark.parametrize(
    ("model", "truth", "message"),
    [
        (on_a_line(), on_a_line(), "the reference's camera centres lie on one line"),
        (poses(5), on_a_line(), "the reference's camera centres lie on one line"),
        (on_a_line(), poses(5), "the model's camera centres lie on one line"),
        (poses(5), on_a_line(off=1e-5), "the reference's camera centres"),
        (moved(poses(5), 0, np.eye(3), 1), poses(5), "the model's camera centres"),
        (poses(2), poses(5), "2 common images with a pose; at least 3"),
        (poses(5), {"x.jpg": poses()["0.jpg"]}, "no common images .*'0.jpg'.*'x.jpg'"),
        ({}, poses(5), "no common images .*'none'"),
        (poses(5), {}, "no common images .*'none'"),
    ],
)
def test_poses_that_fix_no_alignment_are_refused(model, truth, message):
    with pytest.raises(UserError, match=message):
        evaluate(model, truth)


@pytest.mark.parametrize("n", [3, 4, 7])
@pytest.mark.parametrize("height", [0.0, 3.0])
def test_centres_in_one_plane_are_enough(n, height):
    """As of a drone; pycolmap.estimate_sim3d gives None where the plane is exact."""
    flat = np.asarray([1.0, 1, 0])
    truth = {k: p._replace(centre=p.centre * flat + [0, 0, height]) for k, p in poses(n).items()}
    assert evaluate(truth, truth).position["max"] < 1e-9


def test_a_mirrored_model_is_not_mirrored_back():
    truth, mirror = poses(), np.asarray([1, 1, -1])
    model = {name: pose._replace(centre=pose.centre * mirror) for name, pose in truth.items()}
    assert evaluate(model, truth).position["max"] > 0.1


def test_align_on_names_are_the_models_or_the_references_and_known():
    truth = poses()
    model = {name.replace("jpg", "png"): pose for name, pose in truth.items()}
    names = ["0.jpg", "1.png", "2.jpg", "2.png"]
    assert evaluate(model, truth, align_on=names).aligned_on == 3
    with pytest.raises(UserError, match="--align-on: no image named 'x.jpg'"):
        evaluate(model, truth, align_on=[*names, "x.jpg"])
    with pytest.raises(UserError, match="2 common images"):
        evaluate(model, truth, align_on=names[:2])


def test_align_on_files_have_a_name_a_line(tmp_path):
    path = tmp_path / "day.txt"
    path.write_text("# day\n a b.jpg \n\n  # indented\nc.jpg\n")
    assert read_names(path) == ["a b.jpg", "c.jpg"]
    path.write_text("# nothing\n")
    with pytest.raises(UserError, match="day.txt: no names in it"):
        read_names(path)
    path.write_bytes(b"\xff\xfe\x80")
    for bad in (path, tmp_path / "none.txt"):
        with pytest.raises(UserError, match=f"--align-on {bad}: cannot be read as text"):
            read_names(bad)


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ours", "reference", "pairs"),
    [
        (["0000.jpg"], ["0000.png"], {"0000.jpg": "0000.png"}),
        (["day/0000.jpg"], ["0000.png"], {"day/0000.jpg": "0000.png"}),
        (["0.jpg", "0.png"], ["0.png"], {"0.png": "0.png"}),
        (["0.jpg", "0.tif"], ["0.png"], {}),  # which one?
        (["a/0.jpg", "b/0.jpg"], ["0.png"], {}),
        (["0.jpg"], ["a/0.png", "b/0.png"], {}),
        (["0.jpg"], ["0.jpg", "0.png"], {"0.jpg": "0.jpg"}),
        (["0.jpg", "x.jpg"], ["0.jpg", "1.jpg"], {"0.jpg": "0.jpg"}),
    ],
)
def test_names_match_by_equality_then_by_a_unique_stem(ours, reference, pairs):
    assert pair_names(ours, reference) == pairs


# -- angles ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0, 1e-9, 1e-6, 1e-3, 1, 90, 179, 180])
def test_rotation_angles_are_accurate_near_zero(degrees):
    a = turn([3, -1, 2], 77)
    b = turn([1, 1, 5], degrees) @ a
    assert rotation_angle_deg(a, b) == pytest.approx(degrees, rel=1e-6, abs=3e-14)
    assert rotation_angle_deg(b, a) == rotation_angle_deg(a, b)
