"""Laws of the road from matches to models: which steps are done, how often, and what fails quietly.

The matches of the rendered room are verified as in a run. COLMAP's mapper, the check, and the
refinement are made up.
"""

import dataclasses
import logging
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any

import pycolmap
import pytest
from room_run import CONFIG, NAMES, model_with, room_photos
from test_new_points import all_matches
from verdicts import outcome

from jaxsfm.colmap.reconstruction import fingerprint, registered
from jaxsfm.config import Config
from jaxsfm.io.pairs import exhaustive_pairs
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.options import Step
from jaxsfm.sfm import mapped_stage, mapping, refined_stage, road, selected_stage
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.checker import Checker
from jaxsfm.sfm.mapped_stage import StageCache
from jaxsfm.sfm.refine.one_pass import PassFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refined_models import RefinedModels
from jaxsfm.sfm.refined_stage import Reconstructed
from jaxsfm.sfm.road import Watch, walk
from jaxsfm.sfm.selected_stage import SplitModels

PASS = PassFigures(
    accepted=True,
    candidates=9,
    kept=8,
    dropped=1,
    added=3,
    weak_views=[],
    points=40,
    reprojection_error_px=0.25,
)
REFINED = RefinementFigures(passes=[PASS], registrations=[])
Views = Sequence[int]


def right(views: Views) -> Checked:
    """A check of a model of these views that finds nothing wrong."""
    names = [NAMES[k] for k in views]
    return outcome(names)._replace(explained={*exhaustive_pairs(names)})


def wrong(*parts: Views) -> Checked:
    """A check of a model of these parts, the first of which contradicts the others."""
    explained = {pair for part in parts for pair in right(part).explained}
    return outcome(*([NAMES[k] for k in part] for part in parts))._replace(explained=explained)


class Walker:
    """Walks the road, with mappings whose models and checks are given in turn."""

    def __init__(self, rendered, folder, monkeypatch) -> None:
        self._scene, self._folder = rendered, folder
        self.asked: list[str] = []
        """The steps that were done."""
        self.drafts: list[bool] = []
        """For each mapping, whether the mapper made a draft."""
        self.left: list[tuple[Views, Checked]] = []
        self.find_pose_ambiguities: Callable[[], Any] = lambda: None
        self._now: tuple[Views, Checked] = ((), right(()))

        def counted(owner: Any, name: str) -> None:
            original = getattr(owner, name)

            def wrapped(*args, **kwargs):
                self.asked.append(name)
                return original(*args, **kwargs)

            monkeypatch.setattr(owner, name, wrapped)

        counted(mapped_stage, "verify")
        monkeypatch.setattr(mapping, "run_mapper", self._run_mapper)
        monkeypatch.setattr(Checker, "check", lambda *_: [self._now[1]] if self._now[0] else [])
        monkeypatch.setattr(Checker, "with_pose_ambiguities", self._with_pose_ambiguities)
        monkeypatch.setattr(selected_stage, "split_inconsistent", self._split_groups)
        monkeypatch.setattr(refined_stage, "refine_models", self._refine_models)
        monkeypatch.setattr(road, "register_lost", self._register_lost)

    def walk(
        self,
        *mappings: tuple[Views, Checked],
        without: Sequence[Step] = (),
        config: Config = CONFIG,
        watch: Watch | None = None,
    ) -> Reconstructed:
        self.left, self.asked[:], self.drafts[:] = [*mappings], [], []
        return walk(
            room_photos(self._folder, self._scene, all_matches(self._scene), config=config),
            StageCache(WorkFolder(self._folder / "run", {}), "matches"),
            self._folder / "database.db",
            without=without,
            watch=watch,
        )

    def _run_mapper(self, database, options, *, on_image) -> list[pycolmap.Reconstruction]:
        self.asked.append("map")
        self.drafts.append(options.draft)
        self._now = self.left.pop(0)
        for _ in self._now[0]:
            on_image()
        return [model_with(self._scene, self._now[0])] if self._now[0] else []

    def _with_pose_ambiguities(self, model, done, check):
        self.asked.append("second places")
        self.find_pose_ambiguities()
        return check

    def _split_groups(self, models, checks, *_) -> SplitModels:
        self.asked.append("split")
        return SplitModels(models, checks, checks[0].components)

    def _refine_models(self, models, *_, on_pass, **__) -> RefinedModels:
        self.asked.append("refine")
        on_pass()
        return RefinedModels(models, [REFINED for _ in models], [*range(len(models))])

    def _register_lost(self, given, selected, made, *_) -> Reconstructed:
        self.asked.append("register")
        return made


@pytest.fixture
def walker(rendered, tmp_path, monkeypatch) -> Walker:
    return Walker(rendered, tmp_path, monkeypatch)


ALL = (range(5), right(range(5)))
SPLIT = (range(5), wrong(range(3), range(3, 5)))
BENT = (range(5), right(range(5))._replace(explained=right(range(4)).explained))
FEW = (range(3), right(range(3)))


@pytest.mark.parametrize(
    ("mappings", "kept", "drafts"),
    [
        ([ALL], 0, [True]),
        # Photos contradict each other, or their neighbours.
        ([SPLIT, ALL], 1, [True, True]),
        ([BENT, ALL], 1, [True, True]),
        ([BENT, FEW], 0, [True, True]),
        # Nothing speaks against the model, but it lacks photos.
        ([FEW, ALL], 1, [True, False]),
        ([((), right(())), ALL], 1, [True, False]),
        # The second mapping is no better, and there is no third one.
        ([SPLIT, SPLIT], 0, [True, True]),
        ([FEW, FEW], 0, [True, False]),
        ([FEW, SPLIT], 1, [True, False]),
    ],
)
def test_there_are_two_mappings_at_most_and_the_better_one_is_kept(walker, mappings, kept, drafts):
    made = walker.walk(*mappings)
    assert walker.asked.count("map") == len(mappings) and walker.drafts == drafts
    views, check = mappings[kept]
    assert registered(made.models[0]) == {NAMES[k] for k in views}
    (found,) = made.mapping.checks
    assert found is not None and found.groups == check.check.groups
    sizes = [[len(views)] if views else [] for views, _ in mappings]
    assert [attempt.registered for attempt in made.mapping.attempts] == sizes
    assert made.mapping.basis == ("order" if kept and drafts[1] else "pairs")


def test_what_the_kept_mapping_says_against_itself_is_said(walker):
    made = walker.walk(BENT, FEW)
    (check,) = made.mapping.checks
    assert check is not None and check.apart == [[NAMES[3], NAMES[4]]]
    assert check.verdict == "amber"


def test_what_was_not_checked_is_not_mapped_again(walker):
    walker.walk(SPLIT, config=dataclasses.replace(CONFIG, checked=False))
    assert walker.asked.count("map") == 1


EVERY = ["verify", "map", "map", "split", "second places", "refine", "register"]


@pytest.mark.parametrize(
    ("step", "left"),
    [
        (None, EVERY),
        ("remap", ["verify", "map", "split", "second places", "refine", "register"]),
        ("split", ["verify", "map", "map", "second places", "refine", "register"]),
        ("pose-ambiguity", ["verify", "map", "map", "split", "refine", "register"]),
        ("refine", EVERY[:-1]),
        ("register", EVERY[:-1]),
    ],
)
def test_each_step_can_be_skipped_and_no_other_one_is(walker, step, left):
    walker.walk(SPLIT, SPLIT, without=[step] if step else [])
    assert walker.asked == left


def test_models_that_are_not_refined_take_up_no_photos(walker):
    walker.walk(ALL, config=dataclasses.replace(CONFIG, refinement=None))
    assert "register" not in walker.asked


def test_stages_that_exist_are_not_made_again(walker):
    one = walker.walk(SPLIT, ALL)
    assert walker.asked == ["verify", "map", "map", "second places", "refine", "register"]
    two = walker.walk()
    assert walker.asked == ["register"]  # it has a stage of its own
    assert [*map(fingerprint, two.models)] == [*map(fingerprint, one.models)]
    assert (two.mapping, two.refinement) == (one.mapping, one.refinement)
    walker.walk(without=["pose-ambiguity"])
    assert walker.asked == ["refine", "register"]


@pytest.mark.parametrize("setting", [{"radius": 5}, {"min_score": 0.7}])
def test_a_check_that_would_look_otherwise_is_made_again(walker, setting):
    """The models of the mapper are the same, but what the check says of them need not be."""
    assert CONFIG.refinement is not None
    walker.walk(SPLIT, SPLIT)
    refinement = dataclasses.replace(CONFIG.refinement, **setting)
    walker.walk(SPLIT, SPLIT, config=dataclasses.replace(CONFIG, refinement=refinement))
    assert walker.asked == EVERY[1:]


def test_a_question_about_second_places_that_fails_leaves_the_model_and_one_line(walker, caplog):
    def fails() -> None:
        raise ArithmeticError("no surface")

    walker.find_pose_ambiguities = fails
    with caplog.at_level(logging.WARNING):
        made = walker.walk(ALL)
    assert registered(made.models[0]) == {*NAMES}
    (check,) = made.mapping.checks
    assert check is not None and check.verdict == "green" and not check.pose_ambiguities
    assert [record.getMessage() for record in caplog.records] == [
        "it is not known whether the poses of photos are ambiguous: no surface (ArithmeticError)"
    ]


def test_who_watches_is_told_of_each_stage_photo_and_pass(walker):
    told: list[str] = []

    @contextmanager
    def stage(name: str):
        told.append(name)
        yield

    images, passes = [], []
    watch = Watch(stage, lambda: images.append(1), lambda: passes.append(1))
    walker.walk(FEW, ALL, watch=watch)
    assert told == ["mapping", "refinement", "registration"]
    assert len(images) == 3 and len(passes) == 1  # the second mapping is not counted twice
