"""Laws of models that are taken apart. The check is made up, and the models are COLMAP's."""

import numpy as np
import pycolmap
import pytest
from room_scene import arrays, errors, noisy_model
from verdicts import outcome

from jaxsfm.colmap.bundle_adjustment import bundle_adjust
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.reconstruction import registered
from jaxsfm.sfm import selected_stage as module
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.selected_stage import split_inconsistent

NAMES = [f"{k}.png" for k in range(5)]
OPTIONS = MapOptions(refine_intrinsics=False, threads=1)


class FakeChecker:
    """Says of models with these photos that they are made of these parts."""

    def __init__(self, *parts: tuple[list[str], ...], unchecked: set[str] | None = None) -> None:
        self.parts = {frozenset(sum(each, [])): each for each in parts}
        self.unchecked, self.asked = unchecked, []

    def check(self, models) -> list[Checked | None]:
        (names,) = (frozenset(registered(model)) for model in models)
        self.asked.append(names)
        if names == self.unchecked:
            return [None]
        return [outcome(*self.parts.get(names, (sorted(names),)))]


def taken_apart(models, checks, checker):
    return split_inconsistent(models, checks, checker, OPTIONS)


def bent(rendered) -> pycolmap.Reconstruction:
    """The room, after a bundle adjustment in which two photos see everything 6 px aside."""
    model = arrays(noisy_model(rendered, 0.0), rendered)
    wrong = np.isin(model.tracks.view, [3, 4])
    moved = model.tracks.xy + np.where(wrong[:, None], [6.0, -4.0], 0.0)
    bad = model.with_tracks(model.tracks._replace(xy=moved)).to_colmap()
    bundle_adjust(bad, loss_px=50.0, refine_intrinsics=False, threads=1)
    return bad


def test_a_part_is_no_longer_bent_by_the_photos_that_were_joined_to_it_wrongly(rendered):
    model = bent(rendered)
    before = errors(model, rendered)
    found = taken_apart([model], [outcome(NAMES[:3], NAMES[3:])], FakeChecker())
    (left,) = found.models
    assert registered(left) == {*NAMES[:3]} and registered(model) == {*NAMES}
    after = errors(left, rendered)
    assert max(after) < 0.01 * max(before) and min(before) > 0.005
    assert found.split_groups == [NAMES[:3], NAMES[3:]]
    (done,) = found.checks
    assert done is not None and done.check.groups == [NAMES[:3]]


def test_large_errors_count_for_less_in_pixels_of_the_described_photos(rendered, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "bundle_adjust", lambda _, **given: asked.append(given["loss_px"]))
    parts = outcome(NAMES[:3], NAMES[3:])
    options = MapOptions(refine_intrinsics=False, threads=1, scale=4.0)
    split_inconsistent([noisy_model(rendered, 0.0)], [parts], FakeChecker(), options)
    assert asked == [4.0 * module.UNREFINED_LOSS_PX]


def test_models_without_contradictions_stay_as_they_are_and_are_not_checked_again(rendered):
    model, checker = noisy_model(rendered, 0.0), FakeChecker()
    found = taken_apart([model, model], [outcome(NAMES), None], checker)
    assert found.models == [model, model] and found.checks == [outcome(NAMES), None]
    assert found.split_groups == [] == checker.asked


def test_every_part_is_a_model_the_largest_first_among_all(rendered, monkeypatch):
    """A whole model of three photos stands before the part of two."""
    monkeypatch.setattr(module, "MIN_VIEWS", 2)
    whole = noisy_model(rendered, 0.0, use=None)
    whole.deregister_frame(1)
    whole.deregister_frame(2)
    parts = outcome(NAMES[:1] + NAMES[2:4], [NAMES[1], NAMES[4]])
    found = taken_apart(
        [noisy_model(rendered, 0.0), whole], [parts, outcome(NAMES[2:])], FakeChecker()
    )
    sizes = [model.num_reg_images() for model in found.models]
    assert sizes == [3, 3, 2] and found.split_groups == parts.components
    groups = [done.check.groups[0] if done else [] for done in found.checks]
    assert sorted(groups) == sorted([*parts.components, NAMES[2:]])
    for model, group in zip(found.models, groups, strict=True):
        assert registered(model) == set(group)


def test_a_part_in_which_photos_still_contradict_each_other_is_taken_apart_again(
    rendered, monkeypatch
):
    monkeypatch.setattr(module, "MIN_VIEWS", 2)
    checker = FakeChecker((NAMES[:2], NAMES[2:4]))
    found = taken_apart([noisy_model(rendered, 0.0)], [outcome(NAMES[:4], NAMES[4:])], checker)
    assert [registered(model) for model in found.models] == [{*NAMES[:2]}, {*NAMES[2:4]}]
    assert found.split_groups == [NAMES[:2], NAMES[2:4], NAMES[4:]]
    assert all(done and not done.check.contradictions for done in found.checks)


@pytest.mark.parametrize("unchecked", [None, {*NAMES[:3]}])
def test_a_model_of_which_nothing_would_be_left_stays_whole(rendered, unchecked):
    """All parts are too small, or have too few points to be checked."""
    model, checker = noisy_model(rendered, 0.0), FakeChecker(unchecked=unchecked)
    parts = [NAMES[:2], NAMES[2:4], NAMES[4:]] if unchecked is None else [NAMES[:3], NAMES[3:]]
    found = taken_apart([model], [outcome(*parts)], checker)
    assert found.models == [model] and found.split_groups == []
    (done,) = found.checks
    assert done is not None and done.check.verdict == "red"


def test_a_part_is_named_also_if_another_model_has_some_of_its_photos_in_a_smaller_part(
    rendered, monkeypatch
):
    """COLMAP's models may share photos."""
    monkeypatch.setattr(module, "MIN_VIEWS", 2)
    first, second = [NAMES[:3], NAMES[3:]], [NAMES[:2], NAMES[2:]]
    model = noisy_model(rendered, 0.0)
    found = taken_apart([model, model], [outcome(*first), outcome(*second)], FakeChecker())
    assert sorted(found.split_groups) == sorted([*first, *second])
