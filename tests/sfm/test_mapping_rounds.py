"""Laws of the rounds of mapping and checking. The mapper and the check are made up."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from jaxsfm.colmap.mapper import Attempt, MapOptions
from jaxsfm.colmap.two_views import PairGeometry, TwoView
from jaxsfm.config import Config
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair
from jaxsfm.sfm import mapping as module
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Contradiction, ModelCheck
from jaxsfm.sfm.mapping import MAX_ROUNDS, MappingFigures, VerifiedPairs, build_checked_models

A, B, C, D, E = PAIRS = [("a", "b"), ("a", "c"), ("b", "c"), ("c", "d"), ("d", "e")]
OPTIONS = MapOptions(seed=3)
ALL = Config(checked=True)
"""The view graph is off: all pairs that are not refuted are mapped."""


def contradiction(pair: Pair, contradicted: int = 30) -> Contradiction:
    return Contradiction(images=[pair[0]], others=[pair[1]], tested=100, contradicted=contradicted)


def outcome(refuted=(), suspected=(), explained=()) -> Checked:
    """A check that finds these pairs."""
    against = [contradiction(pair) for pair in (*refuted, *suspected)]
    return Checked(
        ModelCheck(groups=[["a"]], contradictions=against, other_places=[]),
        {pair: contradiction(pair) for pair in refuted},
        {pair: contradiction(pair) for pair in suspected},
        set(explained),
    )


class FakePhotos:
    gray = None

    def working_size(self, name: str) -> tuple[tuple[int, int], tuple[float, float]]:
        return (64, 48), (1.0, 1.0)


class Run(NamedTuple):
    models: list
    figures: MappingFigures
    rounds: list[set[Pair]]
    """The pairs that each round was given."""
    dropped: list[Pair]
    """The pairs that are not in the database at the end."""
    told: list[set[Pair]]
    """The pairs that each check was told to be refuted before."""


@pytest.fixture
def rounds(monkeypatch, tmp_path) -> Callable[..., Run]:
    """Runs the rounds with a check that is a function of the pairs that a model was made from."""

    def drop(path: Path, pairs: list[Pair]) -> None:
        left = [pair for pair in json.loads(path.read_text()) if tuple(pair) not in pairs]
        path.write_text(json.dumps(left))

    def run(
        check: Callable[[frozenset[Pair]], Checked | None],
        *,
        config: Config = ALL,
        two_views: dict[Pair, TwoView] | None = None,
        models: int = 1,
    ) -> Run:
        given: list[set[Pair]] = []
        told: list[set[Pair]] = []

        def build(database, trusted, options, *, on_image):
            assert options is OPTIONS
            given.append(set(trusted))
            assert {tuple(pair) for pair in json.loads(database.read_text())} == given[-1]
            tried = Attempt(mapper="incremental", initial_pair=None, registered=[len(given)])
            return [frozenset(trusted)] * models, [tried]

        def checked(model, images, matches, refinement):
            assert matches.pairs == geometries.keys() and matches.seed == OPTIONS.seed
            told.append(set(matches.refuted))
            return check(model)

        monkeypatch.setattr(module, "build_models", build)
        monkeypatch.setattr(module, "check_model", checked)
        monkeypatch.setattr(module, "drop_pairs", drop)
        monkeypatch.setattr(module, "registered", lambda model: {"a", "b"})
        monkeypatch.setattr(module.Model, "from_colmap", lambda model, sizes: model)
        geometries = two_views or {pair: view() for pair in PAIRS}
        verified, database = tmp_path / "verified.db", tmp_path / "mapped.db"
        verified.write_text(json.dumps(sorted(geometries)))
        photos: module.Photos = FakePhotos()  # pyright: ignore[reportAssignmentType]
        pairs = VerifiedPairs(verified, geometries, {}, photos)
        made, figures = build_checked_models(pairs, database, config=config, options=OPTIONS)
        left = {tuple(pair) for pair in json.loads(database.read_text())}
        assert {tuple(pair) for pair in json.loads(verified.read_text())} == geometries.keys()
        return Run(made, figures, given, sorted(geometries.keys() - left), told)

    return run


def view(turn_deg: float = 0.0, inliers: int = 100) -> TwoView:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    rotation = np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return TwoView(PairGeometry(num_inliers=inliers, rotation=rotation), 10.0, False)


def test_a_model_without_contradictions_takes_one_round(rounds):
    found = rounds(lambda pairs: outcome(explained=pairs))
    assert found.rounds == [set(PAIRS)] and found.dropped == []
    assert found.figures.verdicts == {} and len(found.figures.attempts) == 1
    assert found.figures.checks == [outcome().check]
    assert found.models == [frozenset(PAIRS)]


def test_pairs_that_are_refuted_are_not_given_to_the_next_rounds(rounds):
    """The second model shows another contradiction."""

    def check(pairs):
        refuted = [pair for pair in (A, B) if pair in pairs][:1]
        return outcome(refuted=refuted)

    found = rounds(check)
    every = set(PAIRS)
    assert found.rounds == [every, every - {A}, every - {A, B}]
    assert found.dropped == [A, B] and found.models == [frozenset(every - {A, B})]
    assert {pair for pair, v in found.figures.verdicts.items() if v.refuted} == {A, B}
    assert [a.registered for a in found.figures.attempts] == [[1], [2], [3]]
    assert found.figures.checks == [outcome().check]


def test_suspected_pairs_are_left_out_only_if_no_refuted_ones_are_new(rounds):
    def check(pairs):
        return outcome(
            refuted=[A] if A in pairs else [], suspected=[p for p in (B, C) if p in pairs]
        )

    found = rounds(check)
    every = set(PAIRS)
    assert found.rounds == [every, every - {A}, every - {A, B, C}]


def test_a_check_is_told_which_pairs_were_refuted_before(rounds):
    found = rounds(lambda pairs: outcome(refuted=[p for p in (A, B) if p in pairs][:1]))
    assert found.told == [set(), {A}, {A, B}]


def test_all_models_of_a_round_are_heard(rounds):
    """There are three models; one is not checked."""
    first = iter([outcome(refuted=[A]), None, outcome(refuted=[B])])
    found = rounds(lambda pairs: next(first, outcome()), models=3)
    assert found.rounds == [set(PAIRS), set(PAIRS) - {A, B}]
    assert len(found.models) == 3 and found.figures.checks == [outcome().check] * 3


def test_a_round_that_leaves_no_model_to_check_does_not_count(rounds):
    """The pairs that contradict each other are all that holds the photos together."""
    found = rounds(lambda pairs: outcome(refuted=[A]) if A in pairs else None)
    assert found.rounds == [set(PAIRS), set(PAIRS) - {A}]
    assert found.models == [frozenset(PAIRS)] and found.dropped == []
    assert found.figures.checks == [outcome(refuted=[A]).check]


def test_it_ends_after_the_last_round_and_says_what_is_left(rounds):
    """Two hundred pairs, each of which is refuted in its turn."""
    many = {(f"{k:03d}", f"{k + 1:03d}"): view() for k in range(200)}

    def check(pairs):
        return outcome(refuted=[min(pairs)])

    found = rounds(check, two_views=many)
    assert len(found.rounds) == len(found.figures.attempts) == MAX_ROUNDS
    assert len(found.dropped) == MAX_ROUNDS - 1
    (last,) = found.figures.checks
    assert last is not None and last.verdict == "red"


def test_pairs_that_agree_with_the_last_model_are_taken_back(rounds):
    """B was wrongly suspected: it agrees with the model that was made without A."""

    def check(pairs):
        if A in pairs:
            return outcome(refuted=[A, B])
        return outcome(explained=[B, *pairs])

    found = rounds(check)
    every = set(PAIRS)
    assert found.rounds == [every, every - {A, B}, every - {A}]
    assert found.dropped == [A] and found.models == [frozenset(every - {A})]
    assert {pair for pair, v in found.figures.verdicts.items() if v.refuted} == {A}


def test_pairs_are_not_taken_back_if_that_brings_a_contradiction(rounds):
    """The database is that of the models that are returned."""

    def check(pairs):
        if {A, B} & pairs:
            return outcome(refuted=[p for p in (A, B) if p in pairs])
        return outcome(explained=[B, *pairs])

    found = rounds(check)
    every = set(PAIRS)
    assert found.rounds == [every, every - {A, B}, every - {A}]
    assert found.dropped == [A, B] and found.models == [frozenset(every - {A, B})]
    assert found.figures.checks == [outcome().check]
    assert {pair for pair, v in found.figures.verdicts.items() if v.refuted} == {A, B}


def test_pairs_are_not_taken_back_where_photos_still_contradict_each_other(rounds):
    """There are more contradictions than rounds."""

    def check(pairs):
        return outcome(refuted=[p for p in PAIRS if p in pairs][:1], explained=[A])

    found = rounds(check)
    assert len(found.rounds) == MAX_ROUNDS and A not in found.rounds[-1]


def test_without_the_check_there_is_one_round_and_no_outcome(rounds):
    def check(pairs):
        raise AssertionError("nothing is checked")

    found = rounds(check, config=Config(checked=False))
    assert len(found.rounds) == 1 and found.figures.checks == [None]


def test_a_photo_that_went_away_leaves_the_model_unchecked(rounds, caplog):
    def check(pairs):
        raise ImageError("a.jpg: cannot be read")

    found = rounds(check)
    assert len(found.rounds) == 1 and found.figures.checks == [None]
    assert "a.jpg: cannot be read" in caplog.text


def test_a_model_that_is_too_small_to_be_checked_refutes_nothing(rounds):
    found = rounds(lambda pairs: None)
    assert len(found.rounds) == 1 and found.figures.checks == [None]


def test_a_refuted_pair_says_how_many_points_contradict_it(rounds):
    found = rounds(lambda pairs: outcome(refuted=[A] if A in pairs else []))
    (verdict,) = found.figures.verdicts.values()
    assert verdict.refuted and not verdict.trusted and verdict.rotation_error_deg is None
    assert re.search(r"contradict each other: of 100 points .* 30 are missing", verdict.reason)


def test_a_pair_that_a_refuted_one_outvoted_is_trusted_afterwards(rounds):
    """The true pair is turned by 90 deg against the strong false one, and is weak beside it."""
    false, true = ("b", "c"), ("a", "c")
    turns = {
        ("a", "b"): view(),
        false: view(90, 900),
        ("c", "d"): view(inliers=900),
        true: view(0, 50),
    }

    def check(pairs):
        return outcome(refuted=[false] if false in pairs else [])

    found = rounds(check, config=Config(checked=True, view_graph=True), two_views=turns)
    assert found.rounds == [turns.keys() - {true}, turns.keys() - {false}]
    assert found.figures.verdicts[true].trusted and found.figures.verdicts[false].refuted
    assert found.figures.verdicts.keys() == turns.keys()


def test_strong_pairs_need_a_right_rotation_once_a_pair_is_refuted(rounds):
    """Three views agree; one more strong pair is turned by 40 deg."""
    turns = {A: view(), B: view(), C: view(), D: view(), ("a", "d"): view(40), ("b", "d"): view()}
    turns |= {E: view()}

    def check(pairs):
        return outcome(refuted=[E] if E in pairs else [])

    config = Config(checked=True, view_graph=True)
    found = rounds(check, config=config, two_views=turns)
    assert found.rounds == [set(turns), turns.keys() - {E, ("a", "d")}]
    verdict = found.figures.verdicts["a", "d"]
    assert not verdict.trusted and not verdict.refuted and "deg" in verdict.reason
