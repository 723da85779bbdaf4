"""Laws of the closer looks of a run: at which photos, and what becomes of their matches."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import pycolmap
import pytest
from pair_results import counts, job_and_images, result

from jaxsfm.config import preset
from jaxsfm.io.store import Store
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.runs import closer_looks
from jaxsfm.runs.closer_looks import look_at_lost_photos
from jaxsfm.runs.job import Job
from jaxsfm.sfm import reconstruction
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.reconstruction import StageCache, refine_mapped
from jaxsfm.sfm.stage_files import VerificationFigures
from jaxsfm.sfm.view_graph import Verdict

REFUTED = Verdict(trusted=False, strength=0.0, rotation_error_deg=None, refuted=True)


@pytest.fixture
def asked(monkeypatch, tmp_path):
    """Looks at the lost photos of a run; says at which pairs, and in which store."""

    def of(*models: set[str], **changes: Any) -> list:
        calls, seconds = [], {}

        def look_closer(job: Job, images: dict, pairs: Any, *, store: Store) -> dict:
            calls.append((job, sorted(images), list(pairs), store))
            return {("a", "d"): result(("a", "d"))}

        monkeypatch.setattr(closer_looks, "look_closer", look_closer)
        _, images = job_and_images()
        identity = RunIdentity(version="1", config={}, images={n: n for n in images})
        config = dataclasses.replace(preset("default"), **changes)
        unused: Any = None
        job = Job(
            store=Store(tmp_path, {}),
            weights=unused,
            config=config,
            engine=unused,
            execution=unused,
            seed=7,
        )
        tried = {(a, b): counts(30) for a in "abc" for b in "bcd" if a < b}
        given = SimpleNamespace(images=list(images.values()))
        run: Any = SimpleNamespace(
            mapped=SimpleNamespace(given=given, photos=list(models)),
            matched=SimpleNamespace(counts=tried),
            identity=identity,
        )
        likely = look_at_lost_photos(job, run, seconds)
        assert bool(likely) == bool(calls) == ("closer looks" in seconds)
        return calls

    return of


def test_photos_in_no_model_are_looked_at_with_photos_that_are_in_one(asked):
    ((job, images, pairs, store),) = asked({"a", "b"}, {"c"})
    assert images == list("abcd") and pairs == [("a", "d"), ("b", "d"), ("c", "d")]
    ((_, _, pairs, _),) = asked({"a", "b"})
    assert pairs == [("a", "c"), ("b", "c"), ("a", "d"), ("b", "d")]
    assert job.config == preset("default")  # at full size
    assert store.identity["config"]["closer_looks"] == 4
    assert job.store.identity["config"] == preset("default").matching()


def test_nothing_is_looked_at_where_nothing_is_lost_or_nothing_can_be_placed(asked):
    assert not asked({"a", "b", "c", "d"}) and not asked()
    assert not asked({"a", "b"}, closer_looks=0)
    assert not asked({"a", "b"}, refinement=None)


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
