"""Laws of what is kept inside a stage: an interrupted stage goes on after its last finished part,
and ends as it would have without the interruption."""

import dataclasses

import pycolmap
import pytest
from room_scene import noisy_model, read_of, settings_of
from verdicts import check_of, outcome

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Start
from jaxsfm.colmap.model_images import fingerprint, registered
from jaxsfm.colmap.poses import model_poses
from jaxsfm.config import Config, preset
from jaxsfm.io.kept_folders import Steps
from jaxsfm.sfm import kept_refinement, mapper_runs
from jaxsfm.sfm import rounds as rounds_module
from jaxsfm.sfm.check.check_files import read_outcomes, write_outcomes
from jaxsfm.sfm.check.model_check import Contradiction
from jaxsfm.sfm.checker import VerifiedPairs
from jaxsfm.sfm.kept_refinement import KeptRefinement
from jaxsfm.sfm.mapper_runs import MapperRuns
from jaxsfm.sfm.refine.passes import refine_model
from jaxsfm.sfm.rounds import Rounds

OPTIONS = MapOptions(threads=1)


@pytest.fixture
def steps(tmp_path) -> Steps:
    return Steps(tmp_path / "steps", "key")


@pytest.fixture
def database(rendered, tmp_path):
    """COLMAP's database with the cameras of the room."""
    path = tmp_path / "database.db"
    model = noisy_model(rendered, 0.0)
    with pycolmap.Database.open(path) as db:
        for camera_id in sorted(model.cameras):
            db.write_camera(model.cameras[camera_id], use_camera_id=True)
    return path


@pytest.mark.parametrize(
    "change", ["pose", "point", "photo", "camera", "nothing"], ids=lambda name: name
)
def test_the_fingerprint_of_a_model_changes_with_all_that_it_says(rendered, change):
    model, other = (noisy_model(rendered, 0.0) for _ in range(2))
    assert fingerprint(model) == fingerprint(other)
    if change == "pose":
        first = min(other.reg_image_ids())
        frame = other.frame(other.image(first).frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(
            frame.rig_from_world.rotation, frame.rig_from_world.translation + 1e-9
        )
    elif change == "point":
        other.point3D(min(other.point3D_ids())).xyz += 1e-9
    elif change == "photo":
        other.deregister_frame(other.image(max(other.reg_image_ids())).frame_id)
    elif change == "camera":
        for camera in other.cameras.values():
            camera.params = [*camera.params[:-1], camera.params[-1] + 1e-6]
    assert (fingerprint(model) == fingerprint(other)) == (change == "nothing")


def test_a_run_of_the_mapper_is_made_once_and_its_progress_is_told_again(
    rendered, database, steps, tmp_path, monkeypatch
):
    calls, told = [], []

    def run(path, options, start, on_image):
        calls.append(start)
        return [noisy_model(rendered, 0.0)]

    monkeypatch.setattr(mapper_runs, "run_mapper", run)

    def runs() -> MapperRuns:
        return MapperRuns(
            database,
            tmp_path,
            OPTIONS,
            share=False,
            on_image=lambda: told.append(1),
            steps=steps,
        )

    (first,) = runs().first().models
    assert len(calls) == 1 and not told  # the mapper itself tells of photos when it runs
    (again,) = runs().first().models
    assert len(calls) == 1 and fingerprint(again) == fingerprint(first)
    assert len(told) == len(registered(first))
    for start in (Start(pair=("0.png", "1.png")), Start(names=["0.png"])):
        before = len(calls)
        runs()._kept_run(database, OPTIONS, start, lambda: None)
        runs()._kept_run(database, OPTIONS, start, lambda: None)
        assert calls[before:] == [start]
    runs()._kept_run(database, dataclasses.replace(OPTIONS, seed=1), Start(), lambda: None)
    assert len(calls) == 4


def test_a_run_without_models_is_kept_too(database, steps, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(mapper_runs, "run_mapper", lambda *_: calls.append(1) or [])
    for _ in range(2):
        made = MapperRuns(database, tmp_path, OPTIONS, share=False, steps=steps).first()
        assert made.models == [] and len(calls) == 1


def some_outcome():
    against = Contradiction(images=["a"], others=["b", "c"], tested=50, contradicted=20)
    return outcome(["a"], ["b", "c"])._replace(
        check=dataclasses.replace(check_of("red"), without_sky=True, shrunk=["b"]),
        refuted={("a", "b"): against},
        suspected={("b", "c"): against, ("a", "c"): against},
        explained={("b", "c")},
        against={("a", "b"), ("a", "c")},
    )


def test_outcomes_of_checks_survive_a_file(tmp_path):
    for given in ([], [None], [some_outcome(), None, outcome(["ü", "b"])]):
        write_outcomes(tmp_path / "file.json", given)
        assert read_outcomes(tmp_path / "file.json") == given


def test_a_check_is_made_once_for_a_model_its_pairs_and_what_was_refuted(
    rendered, database, steps, tmp_path, monkeypatch
):
    calls = []

    class FakeChecker:
        def __init__(self, *_):
            pass

        def check(self, models, refuted):
            calls.append(len(models))
            return [some_outcome()]

    monkeypatch.setattr(rounds_module, "Checker", FakeChecker)
    given = VerifiedPairs(database, {}, {}, None)  # pyright: ignore[reportArgumentType]

    def rounds(kept=steps):
        return Rounds(given, database, tmp_path, config=Config(), options=OPTIONS, steps=kept)

    models = [noisy_model(rendered, 0.0)]
    for _ in range(2):
        assert rounds()._checked(models, []) == [some_outcome()]
    assert len(calls) == 1
    rounds()._checked(models, [("a", "b")])
    rounds()._checked([noisy_model(rendered, 0.2)], [])
    assert len(calls) == 3
    with pycolmap.Database.open(database) as db:
        db.write_camera(pycolmap.Camera.create_from_model_name(77, "PINHOLE", 9.0, 8, 6))
    rounds()._checked(models, [])
    assert len(calls) == 4
    rounds(None)._checked(models, [])
    assert len(calls) == 5


def test_an_interrupted_refinement_goes_on_after_its_last_pass(
    rendered, database, tmp_path, monkeypatch
):
    given, done = noisy_model(rendered, 0.3), []
    settings = settings_of(**dataclasses.asdict(preset("default").refinement))
    original = kept_refinement.run_pass

    def counted(*arguments):
        done.append(1)
        return original(*arguments)

    monkeypatch.setattr(kept_refinement, "run_pass", counted)

    def refined(kept: KeptRefinement, last: int = 99):
        def run(*arguments):
            if len(done) >= last:
                raise KeyboardInterrupt
            return kept.run_pass(*arguments)

        def refine():
            return refine_model(given, read_of(rendered), settings, run=run)

        return kept.finished(given, refine, [])

    whole = KeptRefinement(Steps(tmp_path / "whole", ""), "model-0", database)
    model, figures = refined(whole)
    assert figures is not None and len(done) == len(figures.passes) == 2
    assert refined(whole)[1] == figures and len(done) == 2

    broken = KeptRefinement(Steps(tmp_path / "broken", ""), "model-0", database)
    done.clear()
    with pytest.raises(KeyboardInterrupt):
        refined(broken, last=1)
    assert len(done) == 1
    after, again = refined(broken)
    assert len(done) == 2 and again == figures and fingerprint(after) == fingerprint(model)
    for name, pose in model_poses(model).items():
        assert (model_poses(after)[name].centre == pose.centre).all()
