"""Laws of models that share photos and are joined. The check is made up, models are COLMAP's."""

import numpy as np
import pycolmap
import pytest
from room_scene import errors, noisy_model
from verdicts import outcome

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_images import part_of, registered
from jaxsfm.sfm import joined_models as module
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.joined_models import Joiner

NAMES = [f"{k}.png" for k in range(5)]
OPTIONS = MapOptions(refine_intrinsics=False, threads=1)
ELSEWHERE = pycolmap.Sim3d(
    2.5, pycolmap.Rotation3d(np.array([0.1, -0.7, 0.2, 0.678])), np.array([3.0, -1.0, 8.0])
)


class FakeChecker:
    """Says that the photos of all models agree, or of none."""

    def __init__(self, *, agree: bool = True) -> None:
        self.agree, self.asked = agree, []

    def check(self, models, refuted) -> list[Checked | None]:
        (names,) = (sorted(registered(model)) for model in models)
        self.asked.append(names)
        return [outcome(names) if self.agree else outcome(names[:2], names[2:])]


def part(rendered, numbers: list[int], by: pycolmap.Sim3d | None = None):
    """A checked model of some photos of the room, moved elsewhere."""
    names = [NAMES[k] for k in numbers]
    model = part_of(noisy_model(rendered, 0.0), names)
    if by is not None:
        model.transform(by)
    return model, outcome(names)


def joined(models, checker):
    return Joiner(checker, OPTIONS, lambda model: model).join(models)


def test_two_models_of_one_room_are_one_in_the_frame_of_the_larger(rendered):
    first, second = part(rendered, [0, 1, 2, 3]), part(rendered, [1, 2, 3, 4], ELSEWHERE)
    checker = FakeChecker()
    ((model, done),) = joined([first, second], checker)
    assert registered(model) == {*NAMES} and checker.asked == [NAMES]
    assert max(errors(model, rendered)) < 1e-4
    assert done is not None and done.check.groups == [NAMES]
    own, theirs = (
        {each.image(i).name: i for i in each.reg_image_ids()} for each in (model, second[0])
    )
    assert own.items() >= theirs.items()  # the ids of the database


@pytest.mark.parametrize("case", ["contradicted", "red before", "unchecked", "two shared"])
def test_models_stay_as_they_are_if_a_join_is_not_sure(rendered, case):
    first, second = part(rendered, [0, 1, 2, 3]), part(rendered, [1, 2, 3, 4], ELSEWHERE)
    if case == "red before":
        second = second[0], outcome(NAMES[1:3], NAMES[3:])
    elif case == "unchecked":
        first = first[0], None
    elif case == "two shared":
        first = part(rendered, [0, 1, 2])
    given = [first, second]
    found = joined(given, FakeChecker(agree=case != "contradicted"))
    assert [id(model) for model, _ in found] == [id(model) for model, _ in given]


def test_models_with_other_points_in_the_shared_photos_are_not_joined(rendered):
    """The second model's photos lie in other places to each other."""
    first, (model, done) = part(rendered, [0, 1, 2, 3]), part(rendered, [1, 2, 3, 4])
    for k, point in enumerate(sorted(model.point3D_ids())):
        model.point3D(point).xyz = np.random.default_rng(k).normal(size=3)
    checker = FakeChecker()
    assert len(joined([first, (model, done)], checker)) == 2 and checker.asked == []


def test_a_model_whose_photos_another_one_has_is_left_out(rendered):
    whole, inside = part(rendered, [0, 1, 2, 3, 4]), part(rendered, [1, 2, 3])
    checker = FakeChecker()
    ((model, _),) = joined([whole, inside], checker)
    assert model is whole[0] and checker.asked == []


def test_three_models_are_joined_one_after_the_other(rendered, monkeypatch):
    monkeypatch.setattr(module, "MIN_SHARED", 2)
    given = [part(rendered, [0, 1, 2]), part(rendered, [1, 2, 3]), part(rendered, [2, 3, 4])]
    checker = FakeChecker()
    ((model, _),) = joined(given, checker)
    assert registered(model) == {*NAMES} and len(checker.asked) == 2


def test_points_fall_together_within_twelve_pixels_of_the_photos_at_working_size(
    rendered, monkeypatch
):
    """The photos have three pixels for two working pixels."""
    found = []

    def find_join(first, second, *, error_px):
        found.append(error_px)
        return original(first, second, error_px=error_px)

    original = module.find_join
    monkeypatch.setattr(module, "find_join", find_join)
    given = [part(rendered, [0, 1, 2, 3]), part(rendered, [1, 2, 3, 4], ELSEWHERE)]
    options = MapOptions(refine_intrinsics=False, threads=1, scale=1.5)
    ((model, _),) = Joiner(FakeChecker(), options, lambda model: model).join(given)
    assert registered(model) == {*NAMES} and found == [18.0]


@pytest.mark.parametrize(("left", "count"), [(30, 1), (29, 2)])
def test_no_photo_loses_its_observations_in_a_join(rendered, monkeypatch, left, count):
    """A photo with fewer than 30 has no sure place, and each had more."""

    def adjusted(model, **options):
        both = original(model, **options)
        image = next(i for i in both.images.values() if i.name == NAMES[4])
        for k, point in enumerate(list(image.get_observation_points2D())):
            if k >= left and both.exists_point3D(point.point3D_id):
                both.delete_point3D(point.point3D_id)
        return both

    original = module.adjusted
    monkeypatch.setattr(module, "adjusted", adjusted)
    given = [part(rendered, [0, 1, 2, 3]), part(rendered, [1, 2, 3, 4], ELSEWHERE)]
    assert len(joined(given, FakeChecker())) == count
