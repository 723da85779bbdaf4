"""Laws of the closer looks of a run: at which photos, when, and what becomes of their matches."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pycolmap
import pytest
from pair_results import counts, job_and_images, result

from jaxsfm.config import preset
from jaxsfm.io.store import Store
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.runs import lost_photos
from jaxsfm.runs.job import Job
from jaxsfm.runs.lost_photos import refine_with_closer_looks
from jaxsfm.sfm import reconstruction
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.reconstruction import StageCache, refine_mapped
from jaxsfm.sfm.stage_files import VerificationFigures
from jaxsfm.sfm.view_graph import Verdict

REFUTED = Verdict(trusted=False, strength=0.0, rotation_error_deg=None, refuted=True)


class Run:
    """A run of the photos a, b, c and d, and what is asked of it."""

    def __init__(self, folder: Path, models: list[set[str]], **changes: Any):
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
        self.found: Any = SimpleNamespace(
            mapped=SimpleNamespace(given=given, photos=models),
            matched=SimpleNamespace(
                counts={(a, b): counts(30) for a in "abc" for b in "bcd" if a < b}
            ),
            identity=RunIdentity(version="1", config={}, images={n: n for n in self.images}),
        )
        self.seconds: dict[str, float] = {}
        self.looks: list = []
        self.refined: list = []

    def refine(self, folder: Path, *outcomes: list[set[str]]) -> Any:
        """Refine the models; each refinement leaves these models."""
        left = iter(outcomes or [self.found.mapped.photos])

        def refine(mapped: Any, target: Path, closer: dict, *, again: bool = False) -> Any:
            assert mapped is self.found.mapped and target == folder
            self.refined.append((sorted(closer), again))
            return SimpleNamespace(models=next(left))

        stages: Any = SimpleNamespace(refine=refine, seconds=self.seconds)
        return refine_with_closer_looks(self.job, self.found, stages, folder)

    def pairs(self) -> list:
        """The pairs of each look."""
        return [pairs for _, _, pairs, _ in self.looks]


@pytest.fixture
def run_of(monkeypatch, tmp_path):
    """Makes a run of models. A look gives matches of all of its pairs, or of none."""

    def of(*models: set[str], in_vain: bool = False, **changes: Any) -> Run:
        run = Run(tmp_path, list(models), **changes)

        def look_closer(job: Job, images: dict, pairs: Any, *, store: Store) -> dict:
            run.looks.append((job, sorted(images), list(pairs), store))
            return {} if in_vain else {pair: result(pair) for pair in run.looks[-1][2]}

        monkeypatch.setattr(lost_photos, "look_closer", look_closer)
        monkeypatch.setattr(lost_photos, "registered", lambda model: sorted(model))
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
    assert run.refined == [(pairs, False)] and run.seconds.keys() == {"closer looks"}
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
        assert not run.looks and run.refined == [([], False)] and not run.seconds


def test_photos_that_the_refinement_takes_out_are_looked_at_before_they_are_lost(run_of, tmp_path):
    run = run_of({"a", "b", "c"})
    made = run.refine(tmp_path, [{"a", "b"}], [{"a", "b", "c", "d"}])
    before, after = [("a", "d"), ("b", "d"), ("c", "d")], [("a", "c"), ("b", "c")]
    assert run.pairs() == [before, after]
    assert run.refined == [(before, False), (sorted(before + after), True)]
    assert made.models == [{"a", "b", "c", "d"}]


def test_models_are_refined_again_only_if_a_closer_look_found_something(run_of, tmp_path):
    run = run_of({"a", "b", "c", "d"}, in_vain=True)
    assert run.refine(tmp_path, [{"a", "b", "c"}]).models == [{"a", "b", "c"}]
    assert run.pairs() == [[("a", "d"), ("b", "d"), ("c", "d")]] and len(run.refined) == 1


def test_matches_of_closer_looks_say_where_photos_stand_unless_their_pair_is_refuted(
    monkeypatch, tmp_path
):
    ours = {pair: result(pair, 3) for pair in [("a", "b"), ("a", "c"), ("b", "c"), ("b", "d")]}
    closer = {pair: result(pair, 9) for pair in [("a", "c"), ("a", "d"), ("b", "d")]}
    figures = MappingFigures(verdicts={("b", "d"): REFUTED}, attempts=[], checks=[])
    pycolmap.Database.open(tmp_path / "mapped.db").close()
    given: Any = SimpleNamespace(
        config=preset("default"), matches=ours, images=[], options=None, described=None
    )
    mapped: Any = SimpleNamespace(
        figures=figures,
        models=lambda *_: [],
        database=tmp_path / "mapped.db",
        verification=VerificationFigures(verified=dict.fromkeys(ours, 3), angles={}),
        key="k",
    )
    seen = []

    def refine_models(_: Any, photos: Any, believed: Any, **options: Any) -> SimpleNamespace:
        seen.append({pair: each.num_inliers for pair, each in believed.matches.items()})
        return SimpleNamespace(models=[], figures=[], order=[])

    monkeypatch.setattr(reconstruction, "refine_models", refine_models)
    kept = StageCache(WorkFolder(tmp_path / "work", {}), "")
    for matches in (closer, closer, None):
        refine_mapped(given, mapped, tmp_path / "new.db", kept, closer=matches)
    trusted = {("a", "b"): 3, ("b", "c"): 3}
    assert seen == [
        trusted | {("a", "c"): 9, ("a", "d"): 9},
        trusted | {("a", "c"): 3},
    ]  # the same matches are not refined twice
    for matches in (None, closer, None, closer):
        name = "refined-again" if matches else "refined"
        refine_mapped(given, mapped, tmp_path / "new.db", kept, closer=matches, name=name)
    assert len(seen) == 3  # one refinement does not replace the other
