"""Which photos outside a model are tried with quarter turns."""

from types import SimpleNamespace
from typing import Any

import pytest

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import PairCounts
from jaxsfm.runs import turned_photos
from jaxsfm.runs.turned_photos import LEAST_INLIERS, find_turned


class Trials:
    """Trials that note what they are asked."""

    def __init__(self) -> None:
        self.images = {
            name: SimpleNamespace(name=name, orientation=1) for name in ("a", "b", "x", "y")
        }
        self.asked: list[str] = []

    def turn_of(self, name: str, partners: list[str]) -> int:
        assert set(partners) <= {"a", "b"}
        self.asked.append(name)
        return 0


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
    monkeypatch.setattr(turned_photos, "model_poses", lambda model: {})
    monkeypatch.setattr(turned_photos, "quarter_turns", lambda poses, codes: {})
    monkeypatch.setattr(turned_photos, "registered", lambda model: {"a", "b"})
    trials: Any = Trials()
    mapped: Any = SimpleNamespace(stage=SimpleNamespace(models=lambda: ["model"]))
    found = PairCounts(inliers, 1, 2 * inliers, 0, Status.VERIFIED)
    pair = (min(partner, "x"), max(partner, "x"))
    assert find_turned(mapped, trials, {pair: found}) == {}
    assert trials.asked == asked
