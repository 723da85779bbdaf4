"""Right, split and wrong models, from given poses."""

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from verdicts import check_of

from jaxsfm.bench.judges import doubt, judge
from jaxsfm.bench.synthetic import look_at
from jaxsfm.bench.walls import turn
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.report.run_report import RunReport
from jaxsfm.sfm.check.common_places import POSITION_SHARE, ROTATION_DEG, extent, groups
from jaxsfm.sfm.evaluation import Similarity

RADIUS = 5.0


def ring(count=20):
    """Cameras on a ring at changing heights, that look at its centre."""
    poses = {}
    for k in range(count):
        ray = turn(2 * np.pi * k / count).rotation @ np.asarray([0.0, 0.0, 1.0])
        centre = RADIUS * ray + [0, 0.5 * (k % 3), 0]
        poses[f"{k:02d}.png"] = look_at(centre, np.zeros(3))
    return poses


def similarity(seed):
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Similarity(rng.uniform(0.01, 100), q * np.linalg.det(q), rng.normal(size=3) * 100)


def moved(poses, by):
    return {name: by.moved(pose) for name, pose in poses.items()}


def folded(poses, names, angle):
    """The model in which the photos `names` are turned about the scene's axis."""
    return poses | {name: turn(angle).moved(poses[name]) for name in names}


def disturbed(poses, *, position, rotation_deg):
    """Each camera moved by `position` and turned by `rotation_deg`, in random directions."""
    rng = np.random.default_rng(0)
    result = {}
    for name, pose in poses.items():
        step = rng.normal(size=3)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        cross = np.cross(np.eye(3), axis)
        a = np.radians(rotation_deg)
        rotation = np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross
        centre = pose.centre + position * step / np.linalg.norm(step)
        result[name] = CameraPose(rotation @ pose.rotation, centre)
    return result


def part(poses, first, last):
    return dict(list(poses.items())[first:last])


def outcome(models, truth, noticed=False):
    return judge(models, truth, noticed=noticed).outcome


@pytest.mark.parametrize("seed", range(3))
def test_a_model_is_right_in_any_position_scale_and_direction(seed):
    truth = ring()
    exact = moved(truth, similarity(seed))
    assert judge([exact], truth, noticed=False) == ("right", [[20]], 20)
    near = disturbed(truth, position=0.3 * POSITION_SHARE * extent(truth), rotation_deg=1.0)
    assert outcome([moved(near, similarity(seed))], truth) == "right"


def test_a_model_of_noisy_poses_is_right_if_a_fit_to_all_photos_is_within_the_limits():
    """The similarity of any two of its photos is not."""
    truth = ring()
    limit = POSITION_SHARE * extent(truth)
    noisy = disturbed(truth, position=0.6 * limit, rotation_deg=0.8 * ROTATION_DEG)
    assert outcome([moved(noisy, similarity(3))], truth) == "right"


def test_photos_that_were_turned_in_place_are_not_in_the_group():
    truth = ring()
    turned = dict.fromkeys(sorted(truth)[14:], turn(1.0).rotation)
    model = truth | {
        n: CameraPose(truth[n].rotation @ r, truth[n].centre) for n, r in turned.items()
    }
    assert groups(model, truth)[0] == sorted(truth)[:14]


@pytest.mark.parametrize(
    "too_much",
    [{"position": 4 * POSITION_SHARE * 2 * RADIUS, "rotation_deg": 0.0},
     {"position": 0.0, "rotation_deg": 2 * ROTATION_DEG}],
)  # fmt: skip
def test_a_model_beyond_either_limit_is_wrong(too_much):
    truth = ring()
    assert outcome([disturbed(truth, **too_much)], truth) == "wrong, not noticed"


def test_a_half_that_was_turned_onto_the_other_is_wrong_and_both_halves_are_found():
    """As in castle-P19, whose courtyard was taken for its own mirror."""
    truth = ring()
    half = sorted(truth)[10:]
    model = moved(folded(truth, half, np.pi), similarity(1))
    assert groups(model, truth) == [sorted(truth)[:10], half]
    assert outcome([model], truth) == "wrong, not noticed"
    assert outcome([model], truth, noticed=True) == "wrong, noticed"


def test_a_reflected_model_is_wrong():
    truth = ring()
    mirror = np.diag([1.0, 1.0, -1.0])
    model = {
        n: CameraPose(mirror @ p.rotation @ mirror, mirror @ p.centre) for n, p in truth.items()
    }
    assert outcome([model], truth) == "wrong, not noticed"


def test_groups_of_a_pedestal_with_four_equal_sides_are_told_apart():
    """As in statue: groups right in themselves and turned against each other."""
    truth = ring(40)
    names = sorted(truth)
    sizes, model, start = [18, 11, 7, 4], truth, 0
    for side, size in enumerate(sizes):
        model = folded(model, names[start : start + size], -side * np.pi / 2)
        start += size
    assert judge([model], truth, noticed=False).groups == [sizes]


def test_one_photo_of_twenty_may_be_misplaced_but_not_two():
    truth = ring()
    names = sorted(truth)
    assert outcome([folded(truth, names[:1], np.pi)], truth) == "right"
    assert outcome([folded(truth, names[:2], np.pi)], truth) == "wrong, not noticed"


def test_parts_that_are_right_but_not_joined_are_split():
    truth = ring()
    parts = [moved(part(truth, 0, 12), similarity(1)), moved(part(truth, 12, 20), similarity(2))]
    assert judge(parts, truth, noticed=False) == ("split", [[12], [8]], 20)
    assert outcome(parts[:1], truth) == "split"
    assert outcome([part(truth, 0, 18)], truth) == "right"  # one photo of ten may be missing
    wrong = folded(parts[1], sorted(parts[1])[:4], np.pi)
    assert outcome([parts[0], wrong], truth) == "wrong, not noticed"


def test_models_of_two_photos_are_not_judged():
    truth = ring()
    assert outcome([], truth) == outcome([part(truth, 0, 2)], truth) == "no model"
    pair = folded(part(truth, 0, 2), ["00.png"], np.pi)
    assert outcome([part(truth, 2, 20), pair], truth) == "right"


def test_cameras_on_a_line_are_judged_too():
    """There, a fit to the centres is not determined; the cameras' own rotations are."""
    truth = {f"{k}.png": CameraPose(np.eye(3), np.asarray([float(k), 0, 0])) for k in range(8)}
    assert outcome([moved(truth, similarity(0))], truth) == "right"
    shifted = truth | {
        name: CameraPose(np.eye(3), truth[name].centre - [3.0, 0, 0]) for name in sorted(truth)[4:]
    }
    assert judge([shifted], truth, noticed=False) == ("wrong, not noticed", [[4, 4]], 0)


def test_the_order_of_photos_has_no_effect():
    truth = ring()
    model = folded(truth, sorted(truth)[13:], 2.0)
    backwards = dict(reversed(model.items()))
    assert groups(model, truth) == groups(backwards, dict(reversed(truth.items())))


def test_a_run_doubts_its_model_when_its_verdict_is_amber_or_red():
    def report(*checks):
        return cast(RunReport, SimpleNamespace(checked=[*enumerate(checks)]))

    for fine in (None, report(), report(check_of("green"))):
        assert doubt(fine) == ""
    for colour, words in (("amber", "two models may explain"), ("red", "contradict each other")):
        said = doubt(report(check_of("green"), check_of(colour)))
        assert said.startswith(f"{colour}: ") and words in said
    assert doubt(report(check_of("amber"), check_of("red"))).startswith("red: ")
    unconfirmed = dataclasses.replace(check_of("green"), unconfirmed=True)
    assert "do not show most points" in doubt(report(unconfirmed))
