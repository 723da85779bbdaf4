"""Laws of further passes over photos that are to be localized."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pair_results import result

from jaxsfm.config import preset
from jaxsfm.runs import localize
from jaxsfm.runs.localize_report import LocalizedPhoto
from jaxsfm.sfm.register.locate_view import Localization, LocatedView

SOME_VIEW: Any = SimpleNamespace(centre=None)
LOST = Localization(why="lost", on_surface=5)
DOUBTFUL = Localization(view=SOME_VIEW, why="doubtful", on_surface=120, inliers=99)
MANY = Localization(view=SOME_VIEW, why="doubtful", on_surface=500, inliers=100)
TRUSTED = Localization(view=SOME_VIEW, trusted=True, why=None, on_surface=90, inliers=60)


@pytest.fixture
def localized(monkeypatch):
    """What becomes of a photo, by its first and its second localization; with the pairs that were
    matched further."""

    def of(first: Localization, second: Localization, *, likely: bool = True, looks: int = 2):
        asked: list = []
        ours = {("a", "q"): result(("a", "q"), 3), ("b", "q"): result(("b", "q"), 4)}
        closer = {("b", "q"): result(("b", "q"), 30)}

        def locate_photo(query: Any, models: Any, matches: dict, images: Any):
            found = second if matches["b", "q"].num_inliers == 30 else first
            return LocatedView(0, found, np.zeros(0, int))

        def look(pairs: Any) -> dict:
            asked.extend(pairs)
            return closer if likely else {}

        monkeypatch.setattr(localize, "locate_photo", locate_photo)
        config = preset("default") if looks else preset("paper")
        query: Any = SimpleNamespace(
            path="q.png",
            image=SimpleNamespace(name="q", sha256="0"),
            cameras=[SimpleNamespace(source="given")],
            shortlist=["a", "b"],
        )
        run: Any = SimpleNamespace(
            reference=None, photos=SimpleNamespace(name_of=lambda sha256: None)
        )
        model: Any = SimpleNamespace(config=config, views=[])
        images: Any = None
        found = localize._localize_query(query, ours, run, [model], images, look)
        assert isinstance(found, LocalizedPhoto)
        return found, asked

    return of


@pytest.mark.parametrize("first", [LOST, DOUBTFUL])
def test_a_photo_without_a_sure_pose_is_matched_further(localized, first):
    found, asked = localized(first, TRUSTED)
    assert found.found is TRUSTED and asked == [("b", "q"), ("a", "q")]
    assert found.matches == 33  # those that gave the pose


def test_a_pose_that_further_passes_do_not_confirm_replaces_none_but_no_other(localized):
    assert localized(LOST, DOUBTFUL)[0].found is DOUBTFUL
    found, _ = localized(DOUBTFUL, MANY)
    assert found.found is DOUBTFUL and found.matches == 7  # those that gave this pose
    assert localized(DOUBTFUL, LOST)[0].found is DOUBTFUL


def test_where_no_pair_is_likely_nothing_changes(localized):
    found, asked = localized(LOST, TRUSTED, likely=False)
    assert found.found is LOST and len(asked) == 2 and found.matches == 7


@pytest.mark.parametrize("first", [TRUSTED, MANY])
def test_a_sure_pose_and_one_with_many_matches_are_not_looked_for_again(localized, first):
    found, asked = localized(first, TRUSTED)
    assert found.found is first and not asked


def test_the_paper_has_no_further_passes(localized):
    found, asked = localized(LOST, TRUSTED, looks=0)
    assert found.found is LOST and not asked
