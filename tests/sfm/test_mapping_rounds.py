"""Laws of the rounds of mapping and checking. The mapper and the check are made up."""

import dataclasses
import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from jaxsfm.bench.synthetic import look_at
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Attempt, Mapped
from jaxsfm.colmap.poses import CameraPose
from jaxsfm.colmap.two_views import PairGeometry, TwoView
from jaxsfm.config import Config
from jaxsfm.io.images import ImageError
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.sfm import checker, mapper_runs, mapping
from jaxsfm.sfm import rounds as module
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import Contradiction, ModelCheck, OtherPlace
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.hypotheses import MAX_ROUNDS
from jaxsfm.sfm.mapping import MappingFigures, build_checked_models
from jaxsfm.sfm.round import NOTHING_REFUTED, Round
from jaxsfm.sfm.told_apart import Parts

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
        set(),
        [["a"]],
    )


class FakeModel(frozenset[Pair]):
    """The pairs that a model was made from."""

    def num_reg_images(self) -> int:
        return 3


class FakeJoiner(NamedTuple):
    """Joins nothing."""

    checker: object
    options: MapOptions
    finished: Callable

    def join(self, models: list) -> list:
        return models


class FakePhotos:
    gray = None

    def working_size(self, name: str) -> tuple[tuple[int, int], tuple[float, float]]:
        return (64, 48), (1.0, 1.0)


class Run(NamedTuple):
    models: list
    alternative: list
    figures: MappingFigures
    rounds: list[set[Pair]]
    """The pairs that each round was given."""
    dropped: list[Pair]
    """The pairs that are not in the database at the end."""
    told: list[set[Pair]]
    """The pairs that each check was told to be refuted before."""
    searched: list
    """The models in which second places were looked for."""
    strays: list
    """The models from which photos were taken, with these photos."""
    started: list
    """The models for which the mapper was started again."""


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
        seconds: dict[Pair, TwoView] | None = None,
        places: Callable[[frozenset[Pair]], dict] = lambda pairs: {},
        gone: bool = False,
        left_out: Callable[[frozenset[Pair]], bool] = lambda pairs: False,
        joiner: type = FakeJoiner,
        searched_too: dict | None = None,
        go_on: Callable[[], bool] = lambda: True,
    ) -> Run:
        given: list[set[Pair]] = []
        started: list[frozenset[Pair]] = []
        told: list[set[Pair]] = []
        second: dict[frozenset[Pair], tuple] = dict(searched_too or {})
        searched: list[frozenset[Pair]] = []

        drafted = config.refinement is not None

        def first(database, options, *, on_image, run):
            assert options == dataclasses.replace(OPTIONS, draft=drafted)
            pairs = frozenset(tuple(pair) for pair in json.loads(database.read_text()))
            given.append(set(pairs))
            tried = Attempt(mapper="incremental", initial_pair=None, registered=[len(given)])
            return Mapped([FakeModel(pairs)] * models, [tried])

        def again(made, database, trusted, options, *, on_image, run):
            assert options.draft == drafted and set(trusted) == given[-1]
            if not left_out(made.models[0]):
                return made
            started.append(made.models[0])
            tried = Attempt(mapper="incremental", initial_pair=A, registered=[-len(given)])
            whole = FakeModel(made.models[0] | {("z", "z")})
            return Mapped([whole] * models, [*made.attempts, tried])

        def checked(model, images, matches, refinement):
            assert matches.pairs == geometries.keys() and matches.seed == OPTIONS.seed
            told.append(set(matches.refuted))
            found = check(model)
            if found is None:
                return None
            second[model] = found.check.other_places, found.against
            return found._replace(check=dataclasses.replace(found.check, other_places=[]))

        def search(model, images, matches, refinement, against):
            searched.append(model)
            if gone:
                raise ImageError("a.jpg: cannot be read")
            assert against == second[model][1] and matches.seed == OPTIONS.seed
            return second[model][0]

        def keep_outliers(path: Path, pairs: list[Pair]) -> None:
            looked_for.extend(pairs)

        def copy(source: Path, target: Path, pairs: list[Pair]) -> None:
            assert source.exists() and set(pairs) <= (seconds or {}).keys()

        looked_for: list[Pair] = []
        monkeypatch.setattr(module, "keep_outliers", keep_outliers)
        monkeypatch.setattr(module, "verify", lambda path, options: None)
        monkeypatch.setattr(
            module,
            "read_two_views",
            lambda path: {p: v for p, v in (seconds or {}).items() if p in looked_for},
        )
        monkeypatch.setattr(module, "copy_geometries", copy)
        monkeypatch.setattr(module, "Joiner", joiner)
        strays: list[tuple] = []
        monkeypatch.setattr(mapping, "take_out", lambda model, names: strays.append((model, names)))
        monkeypatch.setattr(mapping, "model_poses", places)
        monkeypatch.setattr(mapper_runs, "first_models", first)
        monkeypatch.setattr(mapper_runs, "with_left_out_images", again)
        monkeypatch.setattr(module, "drop_pairs", drop)
        monkeypatch.setattr(checker, "check_model", checked)
        monkeypatch.setattr(checker, "second_places", search)
        monkeypatch.setattr(checker, "registered", lambda model: {"a", "b"})
        monkeypatch.setattr(checker.Model, "from_colmap", lambda model, sizes: model)
        geometries = two_views or {pair: view() for pair in PAIRS}
        verified, database = tmp_path / "verified.db", tmp_path / "mapped.db"
        verified.write_text(json.dumps(sorted(geometries)))
        photos: checker.Photos = FakePhotos()  # pyright: ignore[reportAssignmentType]
        pairs = VerifiedPairs(verified, geometries, {}, photos)
        made, figures, other = build_checked_models(
            pairs, database, config=config, options=OPTIONS, go_on=go_on
        )
        left = {tuple(pair) for pair in json.loads(database.read_text())}
        assert {tuple(pair) for pair in json.loads(verified.read_text())} == geometries.keys()
        return Run(
            made,
            other,
            figures,
            given,
            sorted(geometries.keys() - left),
            told,
            searched,
            strays,
            started,
        )

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


@pytest.mark.parametrize(("second", "count"), [(101, 3), (100, 3), (99, 2)])
def test_rounds_end_if_far_fewer_photos_have_consistent_places(rounds, second, count):
    """Two thirds of the pairs of the best round are enough to go on. The first round stays."""

    def check(pairs):
        size = 150 if A in pairs else second
        parts = [["a", "b"]] * (size if C in pairs else 1)
        refuted = [next(pair for pair in (A, B, C) if pair in pairs)] if C in pairs else []
        return outcome(refuted=refuted)._replace(parts=parts)

    found = rounds(check)
    assert len(found.rounds) == (count if count == 2 else 4)
    assert found.models == [frozenset(PAIRS if count == 2 else set(PAIRS) - {A, B, C})]


def test_the_mapper_is_started_again_only_if_no_photos_contradict_each_other(rounds):
    """It leaves out photos in both rounds. What it finds then is checked."""

    def check(pairs):
        return outcome(refuted=[A] if A in pairs else [])

    found = rounds(check, left_out=lambda pairs: True)
    second = frozenset(set(PAIRS) - {A})
    assert found.rounds == [set(PAIRS), set(PAIRS) - {A}]
    assert found.started == [second] and len(found.told) == 3
    assert found.models == [second | {("z", "z")}]
    assert [a.registered for a in found.figures.attempts] == [[1], [2], [-2]]


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
    # Squares are no numbers of a sequence.
    many = {(f"{k**2:06d}", f"{(k + 1) ** 2:06d}"): view() for k in range(200)}

    def check(pairs):
        return outcome(refuted=[min(pairs)])

    found = rounds(check, two_views=many)
    assert len(found.rounds) == len(found.figures.attempts) == MAX_ROUNDS
    assert len(found.dropped) == MAX_ROUNDS - 1
    (last,) = found.figures.checks
    assert last is not None and last.verdict == "red"


def one_after_the_other(last: int) -> Callable[[frozenset[Pair]], Checked]:
    """Of the first pairs, each is refuted in its turn, and nothing else."""

    def check(pairs):
        return outcome(refuted=[pair for pair in PAIRS[:last] if pair in pairs][:1])

    return check


@pytest.mark.parametrize("goes_on", [True, False])
def test_it_is_asked_once_whether_to_go_on_after_two_rounds_of_contradictions(rounds, goes_on):
    asked = []
    found = rounds(one_after_the_other(3), go_on=lambda: asked.append(0) or goes_on)
    assert len(found.rounds) == (4 if goes_on else 2) and len(asked) == 1
    assert found.figures.cut_short == (not goes_on)
    assert found.models == [frozenset(PAIRS[3:] if goes_on else PAIRS[1:])]
    verdicts = [each.verdict for each in found.figures.checks if each]
    assert verdicts == ["green" if goes_on else "red"]


@pytest.mark.parametrize("last", [0, 1])
def test_it_is_not_asked_whether_to_go_on_if_two_rounds_are_enough(rounds, last):
    found = rounds(one_after_the_other(last), go_on=lambda: pytest.fail("asked"))
    assert len(found.rounds) == last + 1 and not found.figures.cut_short


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


def test_a_refuted_pair_is_used_with_its_second_geometry_and_dropped_the_second_time(rounds):
    """The second geometry has another rotation; a third one is not looked for."""
    seen = []

    def check(pairs):
        seen.append(pairs)
        return outcome(refuted=[A] if A in pairs else [])

    found = rounds(check, seconds={A: view(33)})
    every = set(PAIRS)
    assert found.rounds == [every, every, every - {A}] and found.dropped == [A]
    assert found.told == [set(), set(), {A}]


def test_suspected_pairs_are_dropped_without_a_second_look(rounds):
    found = rounds(lambda pairs: outcome(suspected=[A] if A in pairs else []), seconds={A: view()})
    assert found.rounds == [set(PAIRS), set(PAIRS) - {A}]


def test_the_best_round_is_returned_not_the_last(rounds):
    """The third model has more contradictions than the second."""

    def check(pairs):
        refuted = [p for p in PAIRS if p in pairs][:1]
        worse = contradiction(refuted[0], {5: 90, 4: 20}.get(len(pairs), 60))
        check = ModelCheck(groups=[["a"]], contradictions=[worse], other_places=[])
        return Checked(check, {refuted[0]: worse}, {}, set(), set(), [["a"]])

    found = rounds(check)
    assert len(found.rounds) == MAX_ROUNDS and found.models == [frozenset(set(PAIRS) - {A})]
    assert found.dropped == [A]


WALK = [f"walk{k}" for k in range(1, 7)]
LINKS = set(itertools.pairwise(WALK))
FALSE = (WALK[0], WALK[3])
TRUE = (WALK[0], WALK[2])
WALKED = {pair: view() for pair in (*LINKS, FALSE, TRUE)}


def walked(pairs, *, against=(), agreeing=(), places=()) -> Checked:
    """A check of the walk: contradictions at these pairs."""
    found = outcome(refuted=against, explained=agreeing)
    check = ModelCheck(
        groups=[WALK], contradictions=found.check.contradictions, other_places=list(places)
    )
    return found._replace(check=check, refuted={})


def posed(turned) -> dict[str, CameraPose]:
    """The walk on an arc; the second half is elsewhere if the false pair was used."""
    poses = {}
    for k, name in enumerate(WALK):
        angle = 0.3 * k + (2.0 if turned and k >= 3 else 0.0)
        centre = np.asarray([np.sin(angle), 0.1 * (k % 2), -np.cos(angle)])
        poses[name] = look_at(4 * centre, np.zeros(3))
    return poses


def test_the_order_of_names_joins_photos_that_pairs_join_wrongly(rounds):
    """All pairs agree with the model but the false one, so these are added to the links."""

    def check(pairs):
        bad = [FALSE] if FALSE in pairs else []
        return walked(pairs, against=bad, agreeing=WALKED.keys() - {FALSE})

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.rounds == [set(WALKED), LINKS, LINKS | {TRUE}]
    assert found.dropped == [FALSE] and found.models == [frozenset(LINKS | {TRUE})]
    (told,) = found.figures.checks
    # Photos contradict the first model, so it is no alternative.
    assert told is not None and told.verdict == "green" and found.alternative == []
    assert "order" in found.figures.verdicts[FALSE].reason


def test_a_green_model_in_which_photos_that_follow_each_other_disagree_is_not_the_result(rounds):
    """Nothing in the photos decides: both models are returned, and the verdict is amber."""

    def check(pairs):
        wrong = {FALSE, (WALK[2], WALK[3])}
        return walked(pairs, agreeing=WALKED.keys() - (wrong if FALSE in pairs else {FALSE}))

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.rounds == [set(WALKED), LINKS, LINKS | {TRUE}]
    assert found.models == [frozenset(LINKS | {TRUE})] and found.dropped == [FALSE]
    assert found.alternative == [frozenset(WALKED)]
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "amber" and told.alternative is not None
    assert told.alternative.basis == "pairs" and told.alternative.elsewhere == WALK[3:]


def test_photos_that_follow_each_other_and_disagree_make_a_model_amber(rounds):
    """Photos contradict the model that follows the order, so it is no alternative."""
    apart = (WALK[2], WALK[3])

    def check(pairs):
        if FALSE in pairs:
            return walked(pairs, agreeing=LINKS - {apart})
        return walked(pairs, against=[FALSE], agreeing=LINKS)

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.models == [frozenset(WALKED)] and found.alternative == []
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "amber" and told.apart == [[*apart]]


def test_the_model_that_follows_the_order_is_asked_for_its_neighbours_too(rounds):
    """A link whose second geometry is wrong agrees with nothing."""
    apart = (WALK[2], WALK[3])

    def check(pairs):
        return walked(pairs, against=[FALSE] if FALSE in pairs else [], agreeing=LINKS - {apart})

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.models == [frozenset(LINKS)] and found.figures.basis == "order"
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "amber" and told.apart == [[*apart]]


def test_pairs_that_were_found_to_be_false_place_no_photos(rounds):
    """After rounds of votes, these are the refuted ones; with the order, all that are left out."""

    def check(pairs):
        bad = [FALSE] if FALSE in pairs else []
        return walked(pairs, against=bad, agreeing=WALKED.keys() - {FALSE})

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.figures.basis == "order" and found.figures.misleading() == {FALSE}
    turns = {A: view(), B: view(), C: view(), D: view(), ("a", "d"): view(40, 5), E: view()}
    config = Config(checked=True, view_graph=True)
    refuted = iter([[E], []])
    found = rounds(lambda pairs: outcome(refuted=next(refuted)), config=config, two_views=turns)
    assert ("a", "d") in found.dropped and found.figures.misleading() == {E}


def test_an_amber_model_stands_alone_if_photos_contradict_the_other(rounds):
    def check(pairs):
        if FALSE in pairs:
            return walked(pairs, places=[PLACE])
        return walked(pairs, against=[FALSE], agreeing=LINKS)

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    (told,) = found.figures.checks
    assert found.models == [frozenset(WALKED)] and found.alternative == []
    assert told is not None and told.alternative is None


def test_two_equal_models_are_not_two(rounds):
    def check(pairs):
        wrong = (WALK[2], WALK[3]) if FALSE in pairs else FALSE
        return walked(pairs, agreeing=WALKED.keys() - {wrong})

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(False))
    (told,) = found.figures.checks
    assert len(found.rounds) == 3 and found.alternative == []
    assert told is not None and told.verdict == "green"


def test_second_places_are_looked_for_in_the_result_and_before_another_model_is_made(rounds):
    """They take longer than the rest of the check."""
    found = rounds(lambda pairs: outcome(explained=pairs))
    assert found.searched == [frozenset(PAIRS)]
    found = rounds(lambda pairs: outcome(refuted=[A] if A in pairs else []))
    assert found.searched == [frozenset(set(PAIRS) - {A})]
    assert rounds(lambda pairs: outcome(refuted=[min(pairs)])).searched == []

    def check(pairs):
        return walked(pairs, agreeing=WALKED, places=[PLACE] if FALSE in pairs else [])

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.searched == [frozenset(WALKED), frozenset(WALKED)]  # the second has all pairs too
    apart = rounds(lambda pairs: walked(pairs), two_views=WALKED, places=lambda pairs: posed(False))
    assert apart.searched == apart.models  # neighbours say it already


def test_a_photo_that_went_away_leaves_second_places_unsearched(rounds, caplog):
    (told,) = rounds(lambda pairs: outcome(explained=pairs), gone=True).figures.checks
    assert told == outcome().check and "a.jpg: cannot be read" in caplog.text


def test_a_model_with_which_all_that_follow_agree_is_not_doubted(rounds):
    found = rounds(lambda pairs: walked(pairs, agreeing=LINKS), two_views=WALKED)
    assert found.rounds == [set(WALKED)]


def test_an_order_of_few_photos_is_not_followed(rounds):
    """But photos that follow each other are asked."""
    guests = {make_pair(WALK[0], f"guest{k**2}"): view() for k in range(2, 9)}
    found = rounds(lambda pairs: walked(pairs), two_views=WALKED | guests)
    assert len(found.rounds) == 1
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "amber" and len(told.apart) == len(LINKS)


def test_an_order_that_gives_no_model_does_not_replace_a_red_one(rounds):
    def check(pairs):
        return walked(pairs, against=[FALSE]) if pairs == WALKED.keys() else None

    found = rounds(check, two_views=WALKED)
    assert len(found.rounds) > 1 and found.models == [frozenset(WALKED)]
    assert found.figures.basis == "pairs" and found.dropped == []


def test_without_an_order_nothing_else_is_tried(rounds):
    renamed = {name: f"walk{int(name[4:]) ** 3}" for name in WALK}
    views = {make_pair(renamed[a], renamed[b]): v for (a, b), v in WALKED.items()}
    found = rounds(lambda pairs: walked(pairs), two_views=views)
    assert len(found.rounds) == 1


def test_a_link_that_joins_opposed_groups_takes_its_second_geometry(rounds):
    """The photos contradict each other until the link has its second geometry."""
    link = (WALK[2], WALK[3])
    tries = iter([True] * 3 + [False] * 9)

    def check(pairs):
        return walked(pairs, against=[link] if next(tries) else [], agreeing=LINKS)

    found = rounds(check, two_views=WALKED, seconds={link: view(20)}, places=lambda p: posed(True))
    assert len(found.rounds) == 5 and found.rounds[3] >= LINKS
    assert found.models == [frozenset(LINKS)]
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "green"


def test_a_sudden_link_takes_its_second_geometry(rounds):
    """One link turns by 80 deg and the others by 10, although nothing contradicts it."""
    link = (WALK[2], WALK[3])
    views = {pair: view(80 if pair == link else 10) for pair in WALKED}
    given = []

    def check(pairs):
        given.append(pairs)
        return walked(pairs, places=[PLACE])

    found = rounds(check, two_views=views, seconds={link: view(12)}, places=lambda p: posed(False))
    assert len(found.rounds) == 5  # the votes; the links, with what agrees; the same again
    again = rounds(check, two_views=views, places=lambda p: posed(False))
    assert len(again.rounds) == 3  # there is no second geometry


PLACE = OtherPlace(image=WALK[0], pairs=[WALK[3]], agreed=99, contradicted=0, rotation_deg=90.0)


def test_links_that_turn_like_the_others_keep_their_geometry(rounds):
    """All links have a second geometry, and none is needed."""
    views = {pair: view(20) for pair in WALKED}
    seconds = dict.fromkeys(LINKS, view(40))
    found = rounds(
        lambda pairs: walked(pairs, places=[PLACE]),
        two_views=views,
        seconds=seconds,
        places=lambda p: posed(False),
    )
    assert len(found.rounds) == 3


def test_of_two_red_models_both_are_shown(rounds):
    """Less contradicts the model that follows the order."""

    def check(pairs):
        if FALSE in pairs:
            return walked(pairs, against=[FALSE, TRUE])
        return walked(pairs, against=[FALSE], agreeing=LINKS)

    found = rounds(check, two_views=WALKED, places=lambda pairs: posed(FALSE in pairs))
    assert found.models == [frozenset(LINKS)] and found.alternative == [frozenset(WALKED)]
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "red" and told.alternative is not None
    assert told.alternative.basis == "pairs" and told.alternative.contradicted == 60


def strayed(pairs, *, wrong, against=()) -> Checked:
    """All links agree with the model but those that are wrong."""
    found = walked(pairs, against=against, agreeing=LINKS - {*wrong})
    return found._replace(against={*wrong})


def test_a_photo_with_which_no_neighbour_agrees_is_taken_out(rounds):
    """The first photo of the walk, and one in its middle."""
    wrong = [(WALK[0], WALK[1]), (WALK[3], WALK[4]), (WALK[4], WALK[5])]
    found = rounds(lambda pairs: strayed(pairs, wrong=wrong), two_views=WALKED)
    gone = {WALK[0], WALK[4], WALK[5]}
    assert found.strays == [(found.models[0], gone)]
    (told,) = found.figures.checks
    assert told is not None and told.verdict == "green" and told.taken_out == sorted(gone)
    assert told.groups == [WALK[1:4]]


def test_a_photo_with_which_one_neighbour_agrees_stays_and_so_does_the_doubt(rounds):
    apart = (WALK[2], WALK[3])
    found = rounds(lambda pairs: strayed(pairs, wrong=[apart]), two_views=WALKED)
    (told,) = found.figures.checks
    assert found.strays == [] and told is not None
    assert told.verdict == "amber" and told.apart == [[*apart]] and told.taken_out == []


def test_nothing_is_taken_out_where_photos_contradict_each_other_or_few_would_remain(rounds):
    first = (WALK[0], WALK[1])
    found = rounds(lambda pairs: strayed(pairs, wrong=[first], against=[FALSE]), two_views=WALKED)
    assert found.strays == [] and found.models
    found = rounds(lambda pairs: strayed(pairs, wrong=LINKS - {first}), two_views=WALKED)
    assert found.strays == []


def test_neighbours_of_which_nothing_is_known_take_no_photo_out(rounds):
    """Too few of their matches lie on the model."""
    first = (WALK[0], WALK[1])
    found = rounds(lambda pairs: walked(pairs, agreeing=LINKS - {first}), two_views=WALKED)
    (told,) = found.figures.checks
    assert found.strays == [] and told is not None and told.apart == [[*first]]


def test_photos_that_are_in_no_model_raise_no_doubt(rounds):
    """The last photo of the walk was not registered, so its pair agrees with nothing."""
    last = (WALK[4], WALK[5])

    def kept(pairs):
        found = walked(pairs, agreeing=LINKS - {last})
        return found._replace(
            check=ModelCheck(groups=[WALK[:5]], contradictions=[], other_places=[])
        )

    assert len(rounds(kept, two_views=WALKED).rounds) == 1


def test_a_larger_model_is_better_than_a_smaller_one_with_fewer_contradictions(rounds):
    """Both are red; the second round has lost a third of the photos."""

    def check(pairs):
        whole = A in pairs
        worse = contradiction(A if whole else B, 90 if whole else 20)
        check = ModelCheck(
            groups=[["a", "b", "c"] if whole else ["a", "b"]],
            contradictions=[worse],
            other_places=[],
        )
        return Checked(check, {A: worse} if whole else {}, {}, set(), set(), [["a"]])

    assert rounds(check).models == [frozenset(PAIRS)]


def test_of_red_rounds_the_one_with_most_photos_in_the_same_part_is_the_result(rounds):
    """The first round has more photos, in small parts; the second has one large part."""
    names = [f"photo{k**2}" for k in range(8)]

    def check(pairs):
        first = A in pairs
        worse = contradiction(A if first else B)
        check = ModelCheck(
            groups=[names if first else names[:6]], contradictions=[worse], other_places=[]
        )
        # 4 * 4 / 2 and 5 * 4 / 2 pairs of photos, less those of a photo with itself
        apart = [names[:4], names[4:]] if first else [[*names[:6]]]
        return Checked(check, {A: worse} if first else {}, {}, set(), set(), apart)

    assert rounds(check).models == [frozenset(set(PAIRS) - {A})]


def test_what_is_red_to_the_end_is_told_apart_and_amber(rounds, monkeypatch):
    """The other model of the round has no contradictions, but the scene repeats itself."""
    parts, asked = [["a", "b", "c"], ["d"]], []

    def told_apart(models, checks, checker, options):
        asked.append((models, [check.check.verdict for check in checks], options))
        left = [outcome(), outcome()]
        return Parts([frozenset("abc"), models[1]], left, parts)

    monkeypatch.setattr(module, "told_apart", told_apart)
    tries = itertools.cycle([outcome(refuted=[A]), outcome()])
    found = rounds(lambda pairs: next(tries), models=2)
    (((_, whole), verdicts, options),) = asked
    assert verdicts == ["red", "green"] and options is OPTIONS
    assert found.models == [frozenset("abc"), whole] and found.searched == []
    assert [told and told.verdict for told in found.figures.checks] == ["amber", "amber"]
    assert [told and told.told_apart for told in found.figures.checks] == [parts, parts]
    # The first of the two models, which was told apart, is still there as one of the two ways.
    assert found.alternative == asked[0][0][:1]
    told = found.figures.checks[0]
    assert told is not None and told.alternative is not None and told.alternative.whole
    assert told.alternative.contradicted == 30 and told.alternative.basis == "pairs"


@pytest.mark.parametrize("red", [False, True])
def test_models_of_the_result_that_share_photos_are_joined(rounds, monkeypatch, red):
    """Also those that were told apart. Their check is that of the joined model."""
    parts = [["a", "b"], ["c", "d"]]
    monkeypatch.setattr(
        module, "told_apart", lambda models, *_: Parts(models, [outcome()] * 2, parts)
    )
    whole = FakeModel({("x", "y")})

    class Joiner(FakeJoiner):
        def join(self, models):
            assert len(models) == 2 and all(not done.check.contradictions for _, done in models)
            return [(whole, outcome(explained=[B]))]

    tries = itertools.cycle([outcome(refuted=[A]), outcome()] if red else [outcome()])
    places = {whole: ([], set())}
    found = rounds(lambda pairs: next(tries), models=2, joiner=Joiner, searched_too=places)
    assert found.models == [whole]
    (told,) = found.figures.checks
    # The joined model has the photo `a` alone, so it does not hold a whole part.
    assert told is not None and told.told_apart == (parts if red else [])
    assert found.searched[-1:] == ([] if red else [whole])


def test_models_that_nothing_contradicts_are_not_told_apart(rounds, monkeypatch):
    monkeypatch.delattr(module, "told_apart")
    assert rounds(lambda pairs: outcome(explained=pairs)).rounds == [set(PAIRS)]


@pytest.mark.parametrize("left, colour", [(8, "amber"), (9, "green"), (10, "green")])
def test_a_model_that_falls_apart_without_the_refuted_pairs_is_amber(rounds, left, colour):
    """Ten photos contradict each other; without a pair, some are together and nothing does."""
    names = [f"photo{k}" for k in range(10)]

    def check(pairs):
        found = outcome(refuted=[A]) if A in pairs else outcome()
        groups = [names] if A in pairs else [names[:left]]
        return found._replace(check=dataclasses.replace(found.check, groups=groups))

    found = rounds(check)
    assert found.models == [frozenset(set(PAIRS) - {A})] and found.alternative == []
    (told,) = found.figures.checks
    assert told is not None and told.verdict == colour
    apart = [names[:left], *([name] for name in names[left:])] if colour == "amber" else []
    assert told.told_apart == apart
    assert bool(found.searched) == (colour == "green")  # it repeats itself: no need to look


def test_a_doubt_stays_if_the_order_of_the_names_only_takes_photos_out_of_the_model(rounds):
    """The model of most pairs is amber: two neighbours do not agree with it. That of the links
    alone has its photos in two models, and nothing speaks against either."""
    halves = itertools.cycle([WALK[:3], WALK[3:]])

    def check(pairs):
        groups = [WALK] if FALSE in pairs else [next(halves)]
        agreeing = {*LINKS} - {(WALK[2], WALK[3])}
        found = walked(pairs, agreeing=agreeing)
        return found._replace(check=dataclasses.replace(found.check, groups=groups))

    found = rounds(check, two_views=WALKED, models=2)
    assert found.models[0] == frozenset(LINKS)
    (told, _) = found.figures.checks
    assert told is not None and told.verdict == "amber" and told.apart == []
    assert told.told_apart == [WALK[:3], WALK[3:]]


def test_of_several_models_each_is_a_group_of_what_fell_apart(rounds):
    names = [f"photo{k}" for k in range(8)]
    tries = itertools.cycle([names[:3], names[3:7]])

    def check(pairs):
        if A in pairs:
            found = outcome(refuted=[A])
            return found._replace(check=dataclasses.replace(found.check, groups=[names]))
        return outcome()._replace(
            check=dataclasses.replace(outcome().check, groups=[next(tries)[:2]])
        )

    found = rounds(check, models=2)
    (one, two) = found.figures.checks
    assert one is not None and two is not None
    assert (
        one.told_apart
        == two.told_apart
        == [
            names[:2],
            names[3:5],
            *([names[k]] for k in (2, 5, 6, 7)),
        ]
    )


def test_strong_pairs_need_a_right_rotation_also_beside_second_geometries(rounds):
    """As above, and the refuted pair has a second geometry."""
    strong = ("a", "d")
    turns = {A: view(), B: view(), C: view(), D: view(), strong: view(40), ("b", "d"): view()}
    turns |= {E: view()}
    tries = iter([[E], []])
    found = rounds(
        lambda pairs: outcome(refuted=next(tries)),
        config=Config(checked=True, view_graph=True),
        two_views=turns,
        seconds={E: view()},
    )
    assert found.rounds == [set(turns), turns.keys() - {strong}]


@pytest.mark.parametrize(
    ("models", "left"),
    [
        (["ab", "cd", "e"], [["a", "b"], ["c", "d"], ["e"]]),
        (["abcd", "e"], [["a", "b", "c", "d"], ["e"]]),  # joined by photos that both share
        (["abc", "cd"], [["a", "b"], ["c", "d"], ["e"]]),
        (["abcde"], []),
    ],
)
def test_parts_that_were_joined_are_one_part(models, left):
    checks = [
        outcome()._replace(check=dataclasses.replace(outcome().check, groups=[[*photos]]))
        for photos in models
    ]
    made = Round("pairs", [], {}, [*checks, None], NOTHING_REFUTED)
    assert mapping._still_apart([["a", "b"], ["c", "d"], ["e"]], made) == left
