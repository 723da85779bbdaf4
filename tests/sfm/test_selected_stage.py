"""When another mapping of the same photos speaks against the one that a run goes on with."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from room_scene import exact_model
from verdicts import outcome

from jaxsfm.sfm.check.model_check import repeats
from jaxsfm.sfm.selected_stage import _alternative

NAMES = [f"{k}.png" for k in range(5)]
CHECK = outcome(NAMES).check


def mapping(rendered, *exchanged: int, contradicted: int = 0) -> Any:
    """A mapping of the room in which two photos have each other's places."""
    model = exact_model(rendered)
    views = [*model.views]
    for here, there in (exchanged, exchanged[::-1]) if exchanged else ():
        views[here] = dataclasses.replace(views[here], name=model.views[there].name)
    models = [model.with_views(views).to_colmap()]
    trust = SimpleNamespace(basis="order")
    return SimpleNamespace(models=models, contradicted=lambda: contradicted, trust=trust)


@pytest.mark.parametrize(
    ("exchanged", "contradicted", "elsewhere"),
    [((), 0, None), ((1, 3), 0, ["1.png", "3.png"]), ((1, 3), 7, None)],
)
def test_another_mapping_counts_if_it_is_another_one_and_its_photos_agree(
    rendered, exchanged, contradicted, elsewhere
):
    other = mapping(rendered, *exchanged, contradicted=contradicted)
    found = _alternative(other, whole=False, check=CHECK, best=mapping(rendered))
    assert (found and found.elsewhere) == elsewhere


def test_photos_that_the_other_mapping_lacks_say_nothing(rendered):
    other = mapping(rendered)
    other.models[0].deregister_frame(2)
    assert _alternative(other, whole=False, check=CHECK, best=mapping(rendered)) is None


def test_the_model_that_was_split_off_counts_although_its_photos_contradict_each_other(rendered):
    whole = mapping(rendered, contradicted=7)
    check = outcome(NAMES[:3]).check
    found = _alternative(whole, whole=True, check=check, best=mapping(rendered))
    assert found is not None and found.whole
    assert (found.elsewhere, found.images, found.contradicted) == (NAMES[3:], 5, 7)


def test_without_another_mapping_there_is_no_alternative(rendered):
    best = mapping(rendered)
    assert _alternative(None, whole=False, check=CHECK, best=best) is None
    empty: Any = SimpleNamespace(models=[])
    assert _alternative(empty, whole=False, check=CHECK, best=best) is None


@given(st.lists(st.integers(1, 5)))
def test_a_scene_repeats_itself_if_two_groups_of_two_photos_were_split_off(sizes):
    groups = [["photo"] * size for size in sizes]
    assert repeats(groups) == (len([size for size in sizes if size >= 2]) >= 2)
