"""Laws of the two mappings of a run: what each trusts, and which one is better."""

import itertools
from collections.abc import Collection, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from verdicts import outcome

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.two_views import PairGeometry, TwoView
from jaxsfm.config import Config, Refinement
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Contradiction
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.limits import TRUST
from jaxsfm.sfm.mapping import MappedModels, Mapper, MappingFigures, Trust
from jaxsfm.sfm.view_graph import Verdict, edge_weights

LETTERS = [*"abcdefghij"]
TURNED = np.diag([-1.0, 1.0, -1.0])
"""Half a turn around the vertical axis."""


class FakeModel(list[str]):
    """The photos of a model."""

    def reg_image_ids(self) -> list[int]:
        return [*range(len(self))]

    def image(self, number: int) -> SimpleNamespace:
        return SimpleNamespace(name=self[number])


def mapped(
    *models: Collection[str],
    checks: Collection[Checked | None] | None = None,
    trust: Trust | None = None,
) -> MappedModels:
    """A mapping with models of these photos. Without checks, nothing was checked."""
    made: Any = [FakeModel(model) for model in models]
    found = [None] * len(made) if checks is None else [*checks]
    return MappedModels(
        trust=trust or Trust(), database=Path("mapped.db"), models=made, checks=found
    )


def whole(names: Collection[str], *, explained: Collection[Pair] = ()) -> Checked:
    """A check that finds nothing wrong with a model of these photos."""
    return outcome(sorted(names))._replace(explained={*explained})


def chain(names: Collection[str]) -> list[Pair]:
    return [*itertools.pairwise(names)]


def contradiction(pair: Pair, contradicted: int = 30) -> Contradiction:
    return Contradiction(images=[pair[0]], others=[pair[1]], tested=100, contradicted=contradicted)


def views(inliers: Mapping[Pair, int], turned: Collection[Pair] = ()) -> dict[Pair, TwoView]:
    return {
        pair: TwoView(
            PairGeometry(num_inliers=count, rotation=TURNED if pair in turned else np.eye(3)),
            20.0,
            False,
        )
        for pair, count in inliers.items()
    }


def mapper(
    two_views: Mapping[Pair, TwoView], *, view_graph: bool = True, refines: bool = True
) -> Mapper:
    photos: Any = None
    given = VerifiedPairs(Path("verified.db"), two_views, {}, photos)
    config = Config(view_graph=view_graph, refinement=Refinement() if refines else None)
    return Mapper(given, config=config, options=MapOptions())


def test_a_photo_that_loses_its_place_loses_all_its_pairs():
    more, fewer = mapped("abcde"), mapped("abcd")
    assert (more.consistent_pairs(), fewer.consistent_pairs()) == (10, 6)
    assert more.better_than(fewer, set()) and not fewer.better_than(more, set())


def test_a_part_that_others_contradict_counts_by_its_own_size():
    split = mapped("abcdef", checks=[outcome([*"abcd"], [*"ef"])])
    assert split.consistent_pairs() == 6 + 1
    five = mapped("abcde", checks=[whole("abcde")])
    assert five.better_than(split, set()) and not split.better_than(five, set())


def test_two_models_have_the_pairs_of_both_and_a_pair_of_both_counts_once():
    assert mapped("abcd", "ef").consistent_pairs() == 6 + 1
    assert mapped("abcd", "cdef").consistent_pairs() == 6 + 5
    assert mapped("abcd", "cdef", "dxy").consistent_pairs() == 6 + 5 + 3
    assert mapped().consistent_pairs() == 0


def test_of_equal_mappings_the_one_is_better_in_which_neighbours_agree():
    following = {("a", "b"), ("b", "c"), ("c", "d"), ("d", "x")}
    bent = mapped("abcd", checks=[whole("abcd", explained=[("a", "b")])])
    right = mapped("abcd", checks=[whole("abcd", explained=[("a", "b"), ("b", "c")])])
    assert bent.apart(following) == {("b", "c"), ("c", "d")}  # x has no place
    assert right.apart(following) == {("c", "d")}
    assert right.better_than(bent, following) and not bent.better_than(right, following)


def test_neighbours_decide_nothing_while_one_mapping_has_more_pairs():
    following = {("a", "b"), ("b", "c")}
    bent = mapped("abcd", checks=[whole("abcd")])
    right = mapped("abc", checks=[whole("abc", explained=following)])
    assert bent.better_than(right, following) and not right.better_than(bent, following)


def test_of_two_mappings_that_are_equally_good_none_is_better():
    one, other = (mapped("abc", checks=[whole("abc")]) for _ in "12")
    assert not one.better_than(other, {("a", "b")}) and not other.better_than(one, {("a", "b")})


def test_pairs_whose_own_photos_contradict_each_other_are_rejected_before_suspected_ones():
    opposed, rejection_candidates = ("a", "b"), ("c", "d")
    one = whole("ab")._replace(rejected={opposed: contradiction(opposed)})
    two = whole("cd")._replace(
        rejection_candidates={rejection_candidates: contradiction(rejection_candidates)}
    )
    assert [*mapped("ab", "cd", checks=[one, two]).rejected()] == [opposed]
    assert [*mapped("ab", "cd", checks=[whole("ab"), two]).rejected()] == [rejection_candidates]
    assert mapped("ab", "cd").rejected() == {}


def test_without_the_view_graph_the_first_mapping_trusts_all_pairs():
    given = views(dict.fromkeys(chain("abcd"), 500))
    assert mapper(given, view_graph=False).trust_votes() == Trust()
    trust = mapper(given).trust_votes()
    assert trust.basis == "pairs" and not trust.dropped() and trust.verdicts.keys() == {*given}


def test_there_is_no_second_mapping_without_rejected_pairs_and_without_numbered_names():
    given = views(dict.fromkeys(chain(LETTERS), 500))
    assert mapper(given).trust_for_remapping(mapped(LETTERS, checks=[whole(LETTERS)])) is None


def test_rejected_pairs_are_rejected_in_the_second_mapping_and_say_why():
    false = ("a", "c")
    given = views(dict.fromkeys([*chain("abcde"), false], 500))
    check = whole("abcde")._replace(rejected={false: contradiction(false, 42)})
    trust = mapper(given).trust_for_remapping(mapped("abcde", checks=[check]))
    assert trust is not None and trust.basis == "pairs" and trust.dropped() == {false}
    verdict = trust.verdicts[false]
    assert verdict.rejected and not verdict.trusted and "of 100 points" in verdict.reason
    assert verdict.edge_weight == 0
    assert "42 are missing" in verdict.reason
    assert not any(each.rejected for pair, each in trust.verdicts.items() if pair != false)


@pytest.mark.parametrize(
    ("trusted", "rejected", "basis", "misleads"),
    [
        (False, True, "pairs", True),
        (False, False, "pairs", False),  # it may only be weak
        (False, False, "order", True),
        (True, False, "order", False),
        (True, True, "pairs", False),
    ],
)
def test_pairs_that_were_found_to_be_false_mislead(trusted, rejected, basis, misleads):
    verdict = Verdict(trusted=trusted, rejected=rejected, edge_weight=1.0, rotation_error_deg=None)
    pair = ("a", "b")
    figures = MappingFigures(verdicts={pair: verdict}, attempts=[], checks=[], basis=basis)
    assert figures.misleading() == ({pair} if misleads else set())


def test_a_rejected_pair_has_no_vote_on_the_others():
    """The strongest pair says that b is turned by half a turn; the rest says that it is not."""
    false, right = ("a", "b"), [("a", "c"), ("b", "c")]
    given = views({false: 1000, **dict.fromkeys(right, 400)}, turned=[false])
    check = whole("abc")._replace(rejected={false: contradiction(false)})
    assert not mapper(given).trust_votes().dropped() & {false}
    trust = mapper(given).trust_for_remapping(mapped("abc", checks=[check]))
    assert trust is not None and trust.dropped() == {false}


NUMBERED = [f"{k}.jpg" for k in range(6)]


def contested(names: list[str], false: Pair) -> dict[Pair, TwoView]:
    """Six photos in a row, and a pair of the first and the last one that is stronger than others.

    If it is joined before them, it leads the first photo astray.
    """
    a, b, c, d, _, f = names
    row = {**dict.fromkeys(chain(names), 700), (d, f): 700, (a, b): 600, (a, c): 600}
    return views({**row, false: 800}, turned=[false])


def test_pairs_of_photos_that_follow_each_other_come_first_in_the_second_mapping():
    false = ("0.jpg", "5.jpg")
    given = mapper(contested(NUMBERED, false))
    assert given.trust_votes().verdicts[false].trusted
    trust = given.trust_for_remapping(mapped(NUMBERED, checks=[whole(NUMBERED)]))
    assert trust is not None and trust.basis == "order"
    assert trust.dropped() == {false} and not trust.verdicts[false].rejected


def test_without_numbers_the_strongest_pairs_come_first_in_the_second_mapping():
    false, rejected = ("a", "f"), ("b", "d")
    check = whole("abcdef")._replace(rejected={rejected: contradiction(rejected)})
    given = mapper(contested([*"abcdef"], false) | views({rejected: 700}))
    trust = given.trust_for_remapping(mapped("abcdef", checks=[check]))
    assert trust is not None and trust.basis == "pairs"
    assert trust.dropped() == {rejected, ("a", "b"), ("a", "c")}


@pytest.mark.parametrize(("registered", "again"), [(9, False), (8, True), (0, True)])
def test_the_mapper_makes_more_effort_if_more_than_a_tenth_is_left_out(registered, again):
    given = mapper(views(dict.fromkeys(chain(LETTERS), 500)))
    votes = given.trust_votes()
    models = [LETTERS[:registered]] if registered else []
    trust = given.trust_thoroughly(mapped(*models, trust=votes))
    assert trust == (Trust(verdicts=votes.verdicts, thorough=True) if again else None)


def test_photos_that_no_trusted_pair_connects_call_for_no_effort():
    given = mapper(views(dict.fromkeys(chain(LETTERS), 500)))
    dropped = Verdict(trusted=False, edge_weight=0.0, rotation_error_deg=None)
    trust = Trust(verdicts={("e", "f"): dropped})
    assert given.trust_thoroughly(mapped(LETTERS[:5], trust=trust)) is None
    assert given.trust_thoroughly(mapped(LETTERS[:5])) == Trust(thorough=True)


def test_without_a_draft_there_is_no_more_effort_to_make():
    given = mapper(views(dict.fromkeys(chain(LETTERS), 500)), refines=False)
    assert given.trust_thoroughly(mapped(LETTERS[:5])) is None


def test_weak_neighbours_say_nothing():
    """Where a photographer walks on to another place, two photos have hardly a match."""
    pairs = {**dict.fromkeys(chain(NUMBERED), 700), ("2.jpg", "3.jpg"): 20, ("0.jpg", "2.jpg"): 700}
    given = views(pairs)
    edge_weight = edge_weights({pair: view.geometry for pair, view in given.items()})
    assert edge_weight["2.jpg", "3.jpg"] < TRUST.strong < edge_weight["1.jpg", "2.jpg"]
    assert mapper(given).following() == {*chain(NUMBERED)} - {("2.jpg", "3.jpg")}
