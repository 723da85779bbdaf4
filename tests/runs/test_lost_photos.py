"""Laws of the closer looks of a run: at which photos, when, and what becomes of their matches."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pycolmap
import pytest
from pair_results import counts, job_and_images, result

from jaxsfm.config import preset
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.store import Store
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.runs import lost_photos
from jaxsfm.runs.job import Job
from jaxsfm.runs.lost_photos import refine_with_closer_looks
from jaxsfm.sfm import refined_stage
from jaxsfm.sfm.mapped_stage import StageCache
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refined_models import RefinedModels
from jaxsfm.sfm.refined_stage import Reconstructed, place_lost, refine_mapped
from jaxsfm.sfm.stage_files import VerificationFigures
from jaxsfm.sfm.view_graph import Verdict

REFUTED = Verdict(trusted=False, strength=0.0, rotation_error_deg=None, refuted=True)


class Run:
    """A run of the photos a, b, c and d, and what is asked of it."""

    def __init__(self, folder: Path, models: list[set[str]], false: set[Pair], **changes: Any):
        unused: Any = None
        self.job = Job(
            store=Store(folder, {}),
            weights=unused,
            config=dataclasses.replace(preset("default"), **changes),
            engine=unused,
            execution=unused,
            seed=7,
        )
        _, self.images = job_and_images()
        given = SimpleNamespace(images=list(self.images.values()))
        stage = SimpleNamespace(figures=SimpleNamespace(misleading=lambda: false))
        self.found: Any = SimpleNamespace(
            mapped=SimpleNamespace(given=given, photos=models, stage=stage),
            matched=SimpleNamespace(
                counts={(a, b): counts(30) for a in "abc" for b in "bcd" if a < b}
            ),
            identity=RunIdentity(version="1", config={}, images={n: n for n in self.images}),
        )
        self.seconds: dict[str, float] = {}
        self.looks: list = []
        self.refined: list = []
        self.placed: list = []

    def refine(self, folder: Path, *left: set[str]) -> Any:
        """Refine the models, which leaves these, or all of them."""

        def refine(mapped: Any, target: Path, closer: dict) -> Any:
            assert mapped is self.found.mapped and target == folder
            self.refined.append(sorted(closer))
            return SimpleNamespace(models=list(left) or self.found.mapped.photos)

        def place(mapped: Any, made: Any, closer: dict) -> str:
            assert mapped is self.found.mapped and made.models == list(left)
            self.placed.append(sorted(closer))
            return "with more photos"

        stages: Any = SimpleNamespace(refine=refine, place=place, seconds=self.seconds)
        return refine_with_closer_looks(self.job, self.found, stages, folder)

    def pairs(self) -> list:
        """The pairs of each look."""
        return [pairs for _, _, pairs, _ in self.looks]


@pytest.fixture
def run_of(monkeypatch, tmp_path):
    """Makes a run of models. A look gives matches of all of its pairs, or of none."""

    def of(*models: set[str], in_vain: bool = False, false: Any = (), **changes: Any) -> Run:
        run = Run(tmp_path, list(models), set(false), **changes)

        def look_closer(job: Job, images: dict, pairs: Any, *, store: Store) -> dict:
            run.looks.append((job, sorted(images), list(pairs), store))
            return {} if in_vain else {pair: result(pair) for pair in run.looks[-1][2]}

        monkeypatch.setattr(lost_photos, "look_closer", look_closer)
        monkeypatch.setattr(lost_photos, "registered_in_any", lambda models: set().union(*models))
        return run

    return of


def test_photos_in_no_model_are_looked_at_with_photos_that_are_in_one(run_of, tmp_path):
    run = run_of({"a", "b"}, {"c"})
    run.refine(tmp_path)
    ((job, images, pairs, store),) = run.looks
    assert images == list("abcd") and pairs == [("a", "d"), ("b", "d"), ("c", "d")]
    assert job.config == preset("default")  # at full size
    assert store.identity["config"]["closer_looks"] == 4
    assert job.store.identity["config"] == preset("default").matching()
    assert run.refined == [pairs] and run.seconds.keys() == {"closer looks"}
    run = run_of({"a", "b"})
    run.refine(tmp_path)
    assert run.pairs() == [[("a", "c"), ("b", "c"), ("a", "d"), ("b", "d")]]


def test_nothing_is_looked_at_where_nothing_is_lost_or_nothing_can_be_placed(run_of, tmp_path):
    for run in (
        run_of({"a", "b", "c", "d"}),
        run_of(),
        run_of({"a", "b"}, closer_looks=0),
        run_of({"a", "b"}, refinement=None),
    ):
        run.refine(tmp_path)
        assert not run.looks and run.refined == [[]] and not run.seconds


def test_photos_that_the_refinement_takes_out_are_looked_at_with_those_that_stay(run_of, tmp_path):
    run = run_of({"a", "b", "c"})
    assert run.refine(tmp_path, {"a"}) == "with more photos"
    before, after = [("a", "d"), ("b", "d"), ("c", "d")], [("a", "b"), ("a", "c")]
    assert run.pairs() == [before, after]
    assert run.refined == [before] and run.placed == [after]


def test_nothing_is_placed_if_no_closer_look_found_anything(run_of, tmp_path):
    run = run_of({"a", "b", "c", "d"}, in_vain=True)
    assert run.refine(tmp_path, {"a", "b", "c"}).models == [{"a", "b", "c"}]
    assert run.pairs() == [[("a", "d"), ("b", "d"), ("c", "d")]] and not run.placed


def test_pairs_that_were_found_to_be_false_are_not_looked_at(run_of, tmp_path):
    run = run_of({"a", "b", "c"}, false=[("a", "d"), ("a", "c")])
    run.refine(tmp_path, {"a", "b"})
    assert run.pairs() == [[("b", "d"), ("c", "d")], [("b", "c")]]


@dataclasses.dataclass
class Stages:
    """What the stages after the mapping are given, with pairs of which ("b", "d") is false."""

    folder: Path
    ours: dict[Pair, PairResult]

    def __post_init__(self) -> None:
        pycolmap.Database.open(self.folder / "mapped.db").close()
        self.kept = StageCache(WorkFolder(self.folder / "work", {}), "")
        self.given: Any = SimpleNamespace(
            config=preset("default"), matches=self.ours, images=[], options=None, described=None
        )
        self.mapped: Any = SimpleNamespace(
            figures=MappingFigures(verdicts={("b", "d"): REFUTED}, attempts=[], checks=[]),
            models=lambda *_: [],
            database=self.folder / "mapped.db",
            verification=VerificationFigures(verified=dict.fromkeys(self.ours, 3), angles={}),
            key="k",
        )


@pytest.fixture
def stages(tmp_path) -> Stages:
    pairs = [("a", "b"), ("a", "c"), ("b", "c"), ("b", "d")]
    return Stages(tmp_path, {pair: result(pair, 3) for pair in pairs})


CLOSER = {pair: result(pair, 9) for pair in [("a", "c"), ("a", "d"), ("b", "d")]}
BELIEVED = {("a", "b"): 3, ("b", "c"): 3, ("a", "c"): 9, ("a", "d"): 9}


def test_matches_of_closer_looks_say_where_photos_stand_unless_their_pair_is_refuted(
    stages, monkeypatch, tmp_path
):
    seen = []

    def refine_models(_: Any, photos: Any, believed: Any, **options: Any) -> RefinedModels:
        seen.append({pair: each.num_inliers for pair, each in believed.matches.items()})
        return RefinedModels([], [], [])

    monkeypatch.setattr(refined_stage, "refine_models", refine_models)
    for matches in (CLOSER, CLOSER, None):
        new = tmp_path / "new.db"
        refine_mapped(stages.given, stages.mapped, new, stages.kept, closer=matches)
    # The same matches are not refined twice.
    assert seen == [BELIEVED, {("a", "b"): 3, ("b", "c"): 3, ("a", "c"): 3}]


def test_photos_without_a_place_are_placed_once_and_each_model_keeps_its_check(stages, monkeypatch):
    """The second model has most photos then."""
    seen, calls = [], []

    def place_photos(models: Any, figures: Any, photos: Any, believed: Any, **options: Any) -> Any:
        seen.append({pair: each.num_inliers for pair, each in believed.matches.items()})
        calls.append((models, figures, options["lost"]))
        return RefinedModels([], ["of the second", "of the first"], [1, 0])

    found = ["of the second", "of the first"], [1, 0]
    monkeypatch.setattr(refined_stage, "place_photos", place_photos)
    monkeypatch.setattr(refined_stage, "fingerprint", sorted)
    monkeypatch.setattr(refined_stage, "registered_in_any", lambda models: set().union(*models))
    monkeypatch.setattr(refined_stage, "read_models", lambda *_: ["second", "first"])
    monkeypatch.setattr(refined_stage.stage_files, "write_refinement", lambda *_: None)
    monkeypatch.setattr(refined_stage.stage_files, "read_refinement", lambda _: found)
    checks: Any = ["first check", "second check"]
    models: Any = [{"a"}, {"b"}]
    figures: Any = ["of one", "of two"]
    before = Reconstructed(
        verification=stages.mapped.verification,
        mapping=dataclasses.replace(stages.mapped.figures, checks=checks),
        models=models,
        alternative=[],
        refinement=figures,
    )
    for closer in (CLOSER, CLOSER, {("a", "c"): CLOSER["a", "c"]}):
        made = place_lost(stages.given, stages.mapped, before, stages.kept, closer)
        assert made.models == ["second", "first"] and made.refinement == found[0]
        assert made.mapping.checks == ["second check", "first check"]
    # The same matches place photos once. "d" has one pair that is not false.
    assert calls == [(models, figures, {"c", "d"}), (models, figures, {"c"})]
    assert seen == [BELIEVED, {("a", "b"): 3, ("b", "c"): 3, ("a", "c"): 9}]
    # Of other models, other photos are lost.
    before = dataclasses.replace(before, models=[{"a"}, {"b", "c"}])
    place_lost(stages.given, stages.mapped, before, stages.kept, {("a", "c"): CLOSER["a", "c"]})
    assert len(calls) == 3 and calls[-1][-1] == set()
