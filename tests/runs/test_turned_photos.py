"""Which photos outside a model are tried with quarter turns."""

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import PairCounts
from jaxsfm.runs import turned_photos
from jaxsfm.runs.turned_photos import LEAST_INLIERS, find_turned


class Trials:
    """Trials that note what they are asked."""

    def __init__(self, names: Iterable[str] = "abxy", turns: int = 0, only: str = "") -> None:
        self.images = {n: ImageFile(name=n, path=Path(n), size=(4, 3), sha256=n) for n in names}
        self.asked: list[str] = []
        self.turns, self.only = turns, only

    def turn_of(self, name: str, partners: list[str]) -> int:
        assert set(partners) <= set("ab")
        self.asked.append(name)
        return self.turns if not self.only or name in self.only else 0


def model(monkeypatch, *, green: bool = True, smaller: str = "") -> Any:
    """A model of `a` and `b`, which are upright, and a smaller one."""
    monkeypatch.setattr(turned_photos, "model_poses", lambda model: {})
    monkeypatch.setattr(turned_photos, "quarter_turns", lambda poses, codes: {})
    monkeypatch.setattr(turned_photos, "registered", set)
    models = ["ab", smaller] if smaller else ["ab"]
    return SimpleNamespace(stage=SimpleNamespace(models=lambda: models), green=lambda: green)


@pytest.mark.parametrize(
    ("partner", "inliers", "asked"),
    [
        ("a", LEAST_INLIERS, ["y"]),
        ("a", LEAST_INLIERS - 1, ["x", "y"]),
        ("y", LEAST_INLIERS, ["x", "y"]),  # both may be stored sideways
    ],
)
def test_a_photo_that_matches_an_upright_one_as_it_is_is_not_tried(
    monkeypatch, partner, inliers, asked
):
    trials: Any = Trials()
    found = PairCounts(inliers, 1, 2 * inliers, 0, Status.VERIFIED)
    pair = (min(partner, "x"), max(partner, "x"))
    assert find_turned(model(monkeypatch), trials, {pair: found}) == {}
    assert trials.asked == asked


@pytest.mark.parametrize(
    ("photos", "green", "turned"),
    [("abx", True, "x"), ("abx", False, "x"), ("abxcdefghi", True, "x"), ("abxcdefghi", False, "")],
)
def test_a_doubtful_model_is_not_made_again_for_one_photo_of_many(
    monkeypatch, photos, green, turned
):
    """All but `x` match an upright photo as they are."""
    trials: Any = Trials(photos, turns=1)
    found = PairCounts(LEAST_INLIERS, 1, LEAST_INLIERS, 0, Status.VERIFIED)
    counts = {("a", name): found for name in photos if name not in "ax"}
    assert [*find_turned(model(monkeypatch, green=green), trials, counts)] == [*turned]


@pytest.mark.parametrize(
    ("only", "turned"), [("c", ""), ("cd", ""), ("cde", "cde"), ("x", "x"), ("cx", "x")]
)
def test_photos_of_a_smaller_model_are_turned_if_most_of_them_are(monkeypatch, only, turned):
    """Photos `c` to `f` are in the smaller model, and `x` is in none."""
    trials: Any = Trials("abcdefx", turns=1, only=only)
    found = find_turned(model(monkeypatch, smaller="acdef"), trials, {})
    assert [*found] == [*turned]


def test_a_photo_of_the_largest_model_is_judged_by_its_place_there(monkeypatch):
    """`b` lies sideways in the largest model, and is in the smaller one, too."""
    models = model(monkeypatch, smaller="bcdef")
    monkeypatch.setattr(turned_photos, "quarter_turns", lambda poses, codes: {"b": 3})
    trials: Any = Trials("abcdef", turns=1, only="c")
    assert [*find_turned(models, trials, {})] == ["b"]
