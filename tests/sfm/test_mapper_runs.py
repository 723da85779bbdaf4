"""Laws of runs of the mapper: what it is given, and what is kept. The mapper is made up."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import Attempt, Mapped
from jaxsfm.sfm import mapper_runs as module
from jaxsfm.sfm.mapper_runs import MapperRuns

OPTIONS = MapOptions(seed=3)


class Model:
    def __init__(self, images: int) -> None:
        self.images = images

    def num_reg_images(self) -> int:
        return self.images


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Runs whose mapper says which file it was given; `whole` counts the triangulations."""
    database, log, whole = tmp_path / "d.db", [], []
    database.write_text("all")

    def first(path: Path, options, *, on_image, run):
        log.append((path.read_text(), options))
        tried = Attempt(mapper="incremental", initial_pair=None, registered=[])
        return Mapped([], [tried])

    def again(made, path, two_views, options, *, on_image, run):
        log.append((path.read_text(), options))
        return Mapped([], [*made.attempts, *made.attempts]) if two_views else made

    def keep(path: Path, kept) -> None:
        path.write_text(f"{kept} of {path.read_text()}")

    def with_all_points(model, path, options):
        whole.append((model, path, options))
        return Model(model.images)

    monkeypatch.setattr(module, "first_models", first)
    monkeypatch.setattr(module, "with_left_out_images", again)
    monkeypatch.setattr(module, "read_inliers", lambda path: path.read_text())
    monkeypatch.setattr(module, "mapper_matches", lambda inliers: f"some of {inliers}")
    monkeypatch.setattr(module, "keep_inliers", keep)
    monkeypatch.setattr(module, "with_all_points", with_all_points)
    scratch = tmp_path / "scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()

    def make(*, share: bool) -> MapperRuns:
        return MapperRuns(database, scratch, OPTIONS, share=share)

    return make, database, log, whole


def test_the_mapper_makes_a_draft_of_a_share_and_the_database_keeps_all(runs):
    make, database, log, _ = runs
    mapper = make(share=True)
    made = mapper.first()
    mapper.with_left_out_images(made, {("a", "b"): "a pair"})
    assert log == [("some of all of all", dataclasses.replace(OPTIONS, draft=True))] * 2
    assert database.read_text() == "all" and len(mapper.attempts) == 2


def test_models_that_are_not_refined_are_made_from_all_matches(runs):
    make, _, log, whole = runs
    mapper = make(share=False)
    mapper.first()
    model = Model(3)
    assert log == [("all", OPTIONS)] and mapper.with_all_points(model) is model and not whole


def test_attempts_that_were_not_made_are_not_counted(runs):
    make, _, _, _ = runs
    mapper = make(share=True)
    made = mapper.first()
    assert mapper.with_left_out_images(made, {}) is made and len(mapper.attempts) == 1


def test_all_points_of_a_model_are_triangulated_once_until_something_changes(runs):
    make, database, _, whole = runs
    mapper, model = make(share=True), Model(3)
    first = mapper.with_all_points(model)
    assert mapper.with_all_points(model) is first
    # The points of all matches are refined later, so they are adjusted as those of a draft.
    assert whole == [(model, database, dataclasses.replace(OPTIONS, draft=True))]
    # Those of a model that is published without refinement are adjusted to the end.
    mapper.with_all_points(model, final=True)
    assert whole.pop() == (model, database, OPTIONS)
    model.images = 2  # a photo was taken out of it
    second = mapper.with_all_points(model)
    assert second is not first and second.num_reg_images() == 2
    assert mapper.with_all_points(model) is second and len(whole) == 2
    mapper.database_changed()
    assert mapper.with_all_points(model) is not second and len(whole) == 3
    assert mapper.with_all_points(Model(2)) is not second and len(whole) == 4
