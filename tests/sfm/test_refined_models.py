"""Laws of what is done to all models of a run. The refinement of one model is made up."""

from pathlib import Path

import pytest
from room_scene import SIZE, noisy_model, read_of
from verdicts import taken_out

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.other_camera import OtherCamera
from jaxsfm.colmap.reconstruction import part_of, registered
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.sfm import refined_models as module
from jaxsfm.sfm.refine.fixed_structure import ResectionMatches
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refined_models import Believed, RefinedModels, refine_models

NAMES = [f"{k}.png" for k in range(5)]
DATABASE, OPTIONS = Path("d.db"), MapOptions(seed=3)
TAKEN_OUT = RefinementFigures(passes=[], registrations=[taken_out(NAMES[4])])
STAYS = RefinementFigures(passes=[], registrations=[])


class FakePhotos:
    def __init__(self, rendered) -> None:
        self.gray, self.rgb = read_of(rendered), None
        self.files = {
            name: ImageFile(name=name, path=Path(name), size=SIZE, sha256="") for name in NAMES
        }

    def median_scale(self) -> float:
        return 1.0

    def working_size(self, name: str) -> tuple[tuple[int, int], tuple[float, float]]:
        return SIZE, (1.0, 1.0)


@pytest.fixture
def refined(rendered, monkeypatch):
    """Refines three models, of five, four and five views. The refinement takes the fifth view out
    of the first one, and leaves the others as they were."""
    whole = noisy_model(rendered, 0.0)
    models = [whole, part_of(whole, NAMES[:4]), noisy_model(rendered, 0.0)]

    def run(*, gone: bool = False, options: MapOptions = OPTIONS) -> tuple[RefinedModels, list]:
        given, coloured = [], []

        def refine_model(model, read, settings, *, resection, with_all_points, **_):
            assert with_all_points("a model") == "whole" and resection == ResectionMatches(
                {}, options.seed
            )
            given.append(model)
            if gone:
                raise ImageError("2.png: cannot be read")
            if model is models[0]:
                return part_of(model, NAMES[:4]), TAKEN_OUT
            return model, STAYS

        def all_points(model, database, of):
            assert (database, of) == (DATABASE, options)
            return "whole" if model == "a model" else part_of(model, NAMES[:3])

        monkeypatch.setattr(module, "refine_model", refine_model)
        monkeypatch.setattr(module, "with_all_points", all_points)
        monkeypatch.setattr(module, "colour_points", lambda model, rgb: coloured.append(model))
        made = refine_models(
            models,
            FakePhotos(rendered),  # pyright: ignore[reportArgumentType]
            Believed(DATABASE, {}),
            config=Config(refinement=Refinement()),
            options=options,
        )
        assert given == models and {*map(id, coloured)} == {*map(id, made.models)}
        return made, models

    return run


def test_the_model_with_most_photos_comes_first_after_photos_were_taken_out(refined):
    made, models = refined()
    assert made.order == [2, 0, 1]
    assert [len(registered(model)) for model in made.models] == [5, 4, 4]
    assert made.models[0] is models[2] and made.models[2] is models[1]
    assert made.figures == [STAYS, TAKEN_OUT, STAYS]


def test_without_a_refinement_models_are_coloured_alone(rendered, monkeypatch):
    models, coloured = [noisy_model(rendered, 0.0)], []
    monkeypatch.setattr(module, "colour_points", lambda model, rgb: coloured.append(model))
    made = refine_models(
        models,
        FakePhotos(rendered),  # pyright: ignore[reportArgumentType]
        Believed(DATABASE, {}),
        config=Config(refinement=None),
        options=OPTIONS,
    )
    assert made == RefinedModels(models, [None], [0]) and coloured == models


def test_a_photo_that_went_away_leaves_the_mappers_models_with_all_points(refined, caplog):
    """Models with all points are those of three photos."""
    made, _ = refined(gone=True)
    assert made.figures == [None] * 3 and [len(registered(m)) for m in made.models] == [3] * 3
    assert "2.png: cannot be read" in caplog.text


@pytest.mark.parametrize("held", [True, False])
def test_a_camera_that_was_held_is_compared_with_the_one_that_the_photos_speak_for(
    refined, monkeypatch, held
):
    other = OtherCamera(model="OPENCV", params=[1.0] * 8, distance_px=4.0, halves_px=0.5)
    monkeypatch.setattr(module, "other_camera", lambda model, *, threads: other)
    options = MapOptions(refine_intrinsics=not held)
    made, _ = refined(options=options)
    assert [figures.camera for figures in made.figures] == [other if held else None] * 3


def test_a_question_about_the_camera_that_fails_leaves_the_model_and_one_line(
    refined, monkeypatch, caplog
):
    def fails(model, *, threads):
        raise ArithmeticError("the distortion folds")

    monkeypatch.setattr(module, "other_camera", fails)
    made, _ = refined(options=MapOptions(refine_intrinsics=False))
    assert made.figures == [STAYS, TAKEN_OUT, STAYS]
    assert [record.getMessage() for record in caplog.records] == [
        "it is not known whether the photos speak for another camera: the distortion folds "
        "(ArithmeticError)"
    ] * 3


@pytest.mark.parametrize(
    ("ratio", "px"),
    [(0.9, 1), (1.0, 1), (1.24, 1), (1.25, 2), (1.4, 2), (1.92, 2), (2.8, 2), (3.0, 4)],
)
def test_keypoints_are_aligned_from_the_nearest_power_of_two_of_their_size(ratio, px):
    """After low-resolution matching, which reduces photos by a quarter or more, it is never one."""
    assert module.described_px(ratio) == px
