"""The judges of `bench ledger`: places, rotations and rings."""

import numpy as np
import pytest
from test_outcomes import disturbed, folded, moved, part, ring, similarity

from jaxsfm.bench.judges import differences, judge, right_photos, ring_groups, rotation_groups
from jaxsfm.bench.walls import turn
from jaxsfm.colmap.poses import CameraPose


def judged(models, truth, names, how, noticed):
    """The outcome, and the number of right photos."""
    found = judge(models, truth, noticed=noticed, how=how, names=names)
    return found.outcome, found.right


def test_only_the_photos_of_right_models_are_right_and_each_once():
    truth = ring()
    names = sorted(truth)
    first, second = part(truth, 0, 12), part(truth, 8, 20)
    assert judged([first, second], truth, truth, "places", False) == ("split", 20)
    bad = folded(second, names[14:], np.pi)
    assert judged([first, bad], truth, truth, "places", True) == ("wrong, noticed", 12)
    one = folded(truth, names[:1], np.pi)
    assert judged([one], truth, truth, "places", False) == ("right", 19)


def test_rough_positions_are_right_if_the_rotations_are():
    truth = ring()
    rough = disturbed(truth, position=2.0, rotation_deg=2.0)
    assert judged([rough], truth, truth, "places", False)[0].startswith("wrong")
    assert judged([rough], truth, truth, "rotations", False) == ("right", 20)
    wrong = folded(rough, sorted(truth)[12:], np.pi / 2)
    assert judged([wrong], truth, truth, "rotations", True) == ("wrong, noticed", 0)


@pytest.mark.parametrize("seed", range(3))
def test_in_a_world_that_is_turned_and_scaled_all_photos_are_turned_rightly(seed):
    truth = ring()
    whole = moved(truth, similarity(seed))
    assert right_photos(*differences(whole, truth)) == sorted(truth)


def test_of_two_groups_that_are_turned_against_each_other_the_larger_one_is_right():
    truth = ring()
    names = sorted(truth)
    joined_wrongly = folded(moved(truth, similarity(0)), names[11:], np.pi / 2)
    assert right_photos(*differences(joined_wrongly, truth)) == names[:11]
    assert rotation_groups(joined_wrongly, truth) == [names[:11], *([n] for n in names[11:])]


@pytest.mark.parametrize(("degrees", "right"), [(9.0, 20), (11.0, 19)])
def test_a_photo_is_right_within_ten_degrees(degrees, right):
    truth = ring()
    off = folded(moved(truth, similarity(0)), ["05.png"], np.radians(degrees))
    assert len(right_photos(*differences(off, truth))) == right


def test_photos_without_a_reference_have_no_rotation_that_is_judged():
    truth = ring()
    model = truth | {"strange.png": truth["00.png"], "another.png": truth["01.png"]}
    assert right_photos(*differences(model, truth)) == sorted(truth)
    assert right_photos(*differences({}, truth)) == []


def test_without_a_reference_only_a_ring_is_judged():
    truth = ring()
    assert judged([truth], None, truth, "places", False) == ("not judged", None)
    assert judged([truth], None, truth, "ring", False) == ("right", 20)


@pytest.mark.parametrize("backwards", [False, True])
def test_a_ring_in_the_order_of_the_names_is_right_whole_or_in_parts(backwards):
    cameras = disturbed(ring(64), position=0.1, rotation_deg=1.0)
    poses = reversed(cameras.values()) if backwards else cameras.values()
    turned = moved(dict(zip(sorted(cameras), poses, strict=True)), similarity(2))
    assert judged([turned], None, turned, "ring", False) == ("right", 64)
    parts = [part(turned, 0, 30), part(turned, 30, 55), part(turned, 55, 64)]
    assert judged(parts, None, turned, "ring", False) == ("split", 64)


def test_a_ring_that_is_cut_goes_back_or_is_bent_to_half_its_angle_is_wrong():
    truth = ring(64)
    names, first = sorted(truth), truth["00.png"]
    cut = folded(truth, names[32:], 2.7)
    back = {n: turn(2 * np.pi * min(k, 64 - k) / 64).moved(first) for k, n in enumerate(names)}
    half = {n: turn(np.pi * k / 64).moved(first) for k, n in enumerate(names)}
    line = {
        n: CameraPose(p.rotation, np.asarray([0.1 * k, 0, 0]))
        for k, (n, p) in enumerate(truth.items())
    }
    assert len(ring_groups(cut, names)[0]) == 32
    for wrong in (cut, back, half, line):
        assert judged([wrong], None, names, "ring", False)[0] == "wrong, not noticed"
