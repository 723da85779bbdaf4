"""Laws of what is done to all models of a run. The refinement of one model is made up."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from room_scene import SIZE, noisy_model, read_of

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model_images import part_of, registered
from jaxsfm.colmap.other_camera import OtherCamera
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.sfm import refined_models as module
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import Placement
from jaxsfm.sfm.refined_models import Believed, RefinedModels, place_photos, refine_models

NAMES = [f"{k}.png" for k in range(5)]
NEW = NAMES[4]
PAIRS = [(NAMES[k], NAMES[k + 1]) for k in range(4)]
DATABASE, OPTIONS = Path("d.db"), MapOptions()


def placement(
    *,
    name: str = NEW,
    registered: bool = False,
    octave_px: int | None = 1,
    candidates: int = 160,
    doubt: str = "",
) -> Placement:
    return Placement(
        name=name,
        registered=registered,
        octave_px=octave_px,
        candidates=candidates,
        agreed=8,
        error_px=0.1,
        doubt=doubt,
    )


class FakePhotos:
    def __init__(self, rendered) -> None:
        self.gray, self.rgb = read_of(rendered), None
        self.files = {
            name: ImageFile(name=name, path=Path(name), size=SIZE, sha256="") for name in NAMES
        }

    def median_scale(self) -> float:
        return 1.0

    def working_size(self, name):
        gray, scale = self.gray(name)
        return (gray.shape[1], gray.shape[0]), scale


@pytest.fixture
def refined(rendered, monkeypatch):
    """Refines two models of four views; the refinement adds the fifth one to each."""
    small = noisy_model(rendered, 0.0)
    small.deregister_frame(small.image(5).frame_id)

    def run(
        placed: Placement,
        against: dict,
        *,
        checked: bool = True,
        gone: bool = False,
        also: Sequence[Placement] = (),
        options: MapOptions = OPTIONS,
    ):
        offered, asked = [], []

        def refine_model(model, read, settings, *, evidence, with_all_points, **_):
            assert with_all_points("a model") == "whole"
            offered.append([image.name for image in evidence.unmapped])
            if gone:
                raise ImageError("2.png: cannot be read")
            added = placed.octave_px and (placed.registered or offered[-1])
            new = noisy_model(rendered, 0.0) if added else model
            return new, RefinementFigures(passes=[], placed=[*also, placed] if added else [])

        def whole(model, database, given):
            assert (database, given) == (DATABASE, options)
            return "whole" if model == "a model" else part_of(model, NAMES[:3])

        def doubts(model, images, refinement, given):
            asked.append(given)
            return against

        cameras = dict.fromkeys(NAMES, (1, None))
        monkeypatch.setattr(module, "read_images", lambda path: cameras)
        monkeypatch.setattr(module, "refine_model", refine_model)
        monkeypatch.setattr(module, "doubts", doubts)
        monkeypatch.setattr(module, "with_all_points", whole)
        monkeypatch.setattr(module, "colour_points", lambda model, rgb: None)
        made = refine_models(
            [small, small],
            FakePhotos(rendered),  # pyright: ignore[reportArgumentType]
            Believed(DATABASE, {}, PAIRS),
            config=Config(refinement=Refinement(), checked=checked),
            options=options,
        )
        return made, offered, asked

    return run


def test_a_photo_that_the_refinement_places_is_in_the_model_if_nothing_speaks_against_it(refined):
    made, offered, asked = refined(placement(), {})
    assert [len(registered(model)) for model in made.models] == [5, 4]
    assert offered == [[NEW], []] and made.order == [0, 1]
    (given,) = asked
    assert given.full_size == {NEW: True} and set(given.neighbours) == set(PAIRS)


def test_a_photo_whose_place_is_doubtful_is_taken_out_and_offered_to_the_next_model(refined):
    made, offered, asked = refined(placement(), {NEW: "a reason"})
    assert [sorted(registered(model)) for model in made.models] == [NAMES[:4]] * 2
    assert offered == [[NEW], [NEW]] and len(asked) == 2
    for figures in made.figures:
        assert figures is not None and [at.doubt for at in figures.placed] == ["a reason"]
    points = made.models[0].points3D.values()
    assert len(points) > 100 and np.isfinite([point.xyz for point in points]).all()


def test_a_photo_that_was_taken_out_before_keeps_its_reason(refined):
    out = placement(name="other.png", doubt="an earlier reason")
    made, _, (given, _) = refined(placement(), {NEW: "a reason"}, also=[out])
    assert given.full_size == {NEW: True}
    for figures in made.figures:
        assert figures is not None
        assert [at.doubt for at in figures.placed] == ["an earlier reason", "a reason"]


@pytest.mark.parametrize(("octave_px", "candidates"), [(2, 9), (1, 161)])
def test_a_dark_photo_is_known_to_be_one(refined, octave_px, candidates):
    """Its pose may come from full size, though fewer than 5 % of the points agree there."""
    _, _, (given,) = refined(placement(octave_px=octave_px, candidates=candidates), {})
    assert given.full_size == {NEW: False}


@pytest.mark.parametrize(
    ("placed", "checked"),
    [
        (placement(), False),
        (placement(registered=True), True),  # the check of the mapper's model has seen it
        (placement(octave_px=None), True),
        (placement(doubt="only 29 points hold it in the model"), True),  # it was taken out
    ],
)
def test_other_photos_are_not_asked_about(refined, placed, checked):
    _, _, asked = refined(placed, {NEW: "a reason"}, checked=checked)
    assert asked == []


def test_a_photo_that_went_away_leaves_the_mappers_models_with_all_points(refined, caplog):
    """Models with all points are those of three photos."""
    made, _, _ = refined(placement(), {}, gone=True)
    assert made.figures == [None, None] and [len(registered(m)) for m in made.models] == [3, 3]
    assert "2.png: cannot be read" in caplog.text


@pytest.mark.parametrize("held", [True, False])
def test_a_camera_that_was_held_is_compared_with_the_one_that_the_photos_speak_for(
    refined, monkeypatch, held
):
    other = OtherCamera(model="OPENCV", params=[1.0] * 8, distance_px=4.0, halves_px=0.5)
    monkeypatch.setattr(module, "other_camera", lambda model, *, threads: other)
    options = MapOptions(refine_intrinsics=not held)
    made, _, _ = refined(placement(), {NEW: "a reason"}, options=options)
    assert [figures.camera for figures in made.figures] == [other if held else None] * 2


@pytest.mark.parametrize(
    ("ratio", "px"),
    [(0.9, 1), (1.0, 1), (1.24, 1), (1.25, 2), (1.4, 2), (1.92, 2), (2.8, 2), (3.0, 4)],
)
def test_keypoints_are_aligned_from_the_nearest_power_of_two_of_their_size(ratio, px):
    """After a first look, which reduces photos by a quarter at least, that is never one."""
    assert module.described_px(ratio) == px


OUT = placement(registered=True, octave_px=None)
BEFORE = RefinementFigures(passes=[], placed=[OUT, placement(name="other.png", doubt="a reason")])


@pytest.fixture
def placed(rendered, monkeypatch):
    """Places the fifth view in models of four and three views, if it may have a place there."""

    def run(
        where: set[int], *, against: dict | None = None, gone: bool = False, figures: tuple = ()
    ) -> tuple[RefinedModels, list, list]:
        models = [part_of(noisy_model(rendered, 0.0), NAMES[:count]) for count in (4, 3)]
        offered, coloured = [], []

        def place_images(model, read, settings, *, evidence):
            assert (settings.refine_intrinsics, settings.threads) == (True, 1)
            offered.append([image.name for image in evidence.unmapped])
            if gone:
                raise ImageError("2.png: cannot be read")
            right = models.index(model) in where
            new = noisy_model(rendered, 0.0) if right else model
            return new, [placement(octave_px=1 if right else None)]

        monkeypatch.setattr(module, "read_images", lambda path: dict.fromkeys(NAMES, (1, None)))
        monkeypatch.setattr(module, "place_images", place_images)
        monkeypatch.setattr(module, "doubts", lambda *_: against or {})
        monkeypatch.setattr(module, "colour_points", lambda model, rgb: coloured.append(model))
        made = place_photos(
            models,
            figures or [BEFORE, BEFORE],
            FakePhotos(rendered),  # pyright: ignore[reportArgumentType]
            Believed(DATABASE, {}, PAIRS),
            lost=[NEW],
            config=Config(refinement=Refinement(), checked=True),
            options=MapOptions(refine_intrinsics=True, threads=1),
        )
        return made, offered, [coloured, models]

    return run


def test_a_lost_photo_gets_a_place_in_the_first_model_that_has_one(placed):
    made, offered, (coloured, models) = placed({0})
    assert offered == [[NEW]] and made.order == [0, 1]
    assert registered(made.models[0]) == set(NAMES) and made.models[1] is models[1]
    assert coloured == made.models[:1]
    first, second = made.figures
    assert first and [at.octave_px for at in first.placed] == [1, 1]
    assert second is BEFORE


def test_the_model_with_most_photos_comes_first_when_photos_were_placed(placed):
    made, offered, (_, models) = placed({1})
    assert offered == [[NEW], [NEW]] and made.order == [1, 0]
    assert made.models[1] is models[0] and made.figures[1] is BEFORE


@pytest.mark.parametrize(
    "given",
    [
        {"where": set()},
        {"where": {0, 1}, "against": {NEW: "why"}},
        {"where": {0}, "gone": True},
    ],
)
def test_models_that_get_no_photo_stay_and_say_what_they_said(placed, given):
    made, offered, (coloured, models) = placed(**given)
    assert offered == [[NEW], [NEW]] and not coloured and made.order == [0, 1]
    assert all(new is old for new, old in zip(made.models, models, strict=True))
    assert all(figures is BEFORE for figures in made.figures)


def test_a_model_that_was_not_refined_gets_no_photo(placed):
    made, offered, _ = placed({0, 1}, figures=(None, BEFORE))
    assert offered == [[NEW]] and made.order == [1, 0] and made.figures[1] is None
