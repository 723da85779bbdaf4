"""Laws of the registration of photos that have no place after the refinement, on the room."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
import pytest
from room_run import NAMES, model_with, room_photos
from room_scene import Room, other_scene
from test_new_points import all_matches
from verdicts import check_of, taken_out

from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import fingerprint, registered
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.sfm.evaluation import evaluate
from jaxsfm.sfm.limits import RegisterLimits
from jaxsfm.sfm.mapped_stage import MatchedPhotos, StageCache, VerificationFigures
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt
from jaxsfm.sfm.refined_stage import Reconstructed
from jaxsfm.sfm.register import lost as module
from jaxsfm.sfm.register.grow import ExtendedModels
from jaxsfm.sfm.register.locate_view import Localization
from jaxsfm.sfm.register.lost import MatchLost, register_lost
from jaxsfm.sfm.selected_stage import SelectedModels
from jaxsfm.sfm.view_graph import Verdict

LOST = NAMES[3]
OUT = taken_out(LOST)
REFINED = RefinementFigures(passes=[], registrations=[])
TAKEN_OUT = RefinementFigures(passes=[], registrations=[OUT])


class Run(NamedTuple):
    """A run of the room after its refinement."""

    given: MatchedPhotos
    selected: SelectedModels
    made: Reconstructed
    kept: StageCache

    def registered(self, match_lost: MatchLost | None = None) -> Reconstructed:
        return register_lost(self.given, self.selected, self.made, self.kept, match_lost)


@pytest.fixture
def run(rendered, tmp_path) -> Callable[..., Run]:
    def make(
        *models: pycolmap.Reconstruction,
        refinement: list[RefinementFigures | None] | None = None,
        photos: Mapping[str, np.ndarray] | None = None,
        false: Collection[Pair] = (),
    ) -> Run:
        given = room_photos(tmp_path, rendered, all_matches(rendered), photos=photos)
        untrusted = Verdict(trusted=False, edge_weight=0.0, rotation_error_deg=None, rejected=True)
        figures = MappingFigures(
            verdicts=dict.fromkeys(false, untrusted),
            attempts=[],
            checks=[check_of("green"), check_of("amber")][: len(models)],
        )
        folder = tmp_path / "selected"
        folder.mkdir()
        selected = SelectedModels(figures, folder, "key")
        write_database(selected.database, given.images, given.matches, given.cameras)
        made = Reconstructed(
            verification=VerificationFigures(verified={}, angles={}),
            mapping=figures,
            models=[*models],
            alternative=[],
            refinement=refinement or [REFINED] * len(models),
        )
        return Run(given, selected, made, StageCache(WorkFolder(tmp_path / "run", {}), "matches"))

    return make


def row_of(figures: RefinementFigures | None, name: str = LOST) -> RegistrationAttempt | None:
    assert figures is not None
    return {row.name: row for row in figures.registrations}.get(name)


def test_a_photo_that_was_taken_out_is_registered_where_it_shows_most_and_that_model_is_adjusted(
    rendered, run
):
    """It shows some of the points of the first model, and more of those of the second one, in which
    a photo is not quite where it was."""
    first, second = model_with(rendered, [0, 1, 2, 4], every=3), model_with(rendered, [0, 1, 2])
    image = next(each for each in second.images.values() if each.name == NAMES[1])
    pose = image.cam_from_world()
    pose.translation = pose.translation + [0.01, 0, 0]
    image.frame.set_cam_from_world(image.camera_id, pose)
    given = run(first, second, refinement=[TAKEN_OUT, REFINED])
    made = given.registered()
    assert [registered(each) for each in made.models] == [{*NAMES} - {LOST}, {*NAMES[:4]}]
    assert fingerprint(made.models[0]) == fingerprint(first)
    before, after = (evaluate(model_poses(m), rendered.poses) for m in (second, made.models[1]))
    assert before.position["max"] > 0.004 and after.position["max"] < 0.002
    row = row_of(made.refinement[1])
    assert row is not None and not row.registered and not row.reason and row.octave_px == 1
    assert [check and check.verdict for check in made.mapping.checks] == ["green", "amber"]
    assert given.made.models[1].num_reg_images() == 3  # what was given has not changed


def test_a_model_with_a_photo_that_rests_on_a_smaller_size_is_not_adjusted(rendered, run):
    coarse = dataclasses.replace(OUT, name=NAMES[0], registered=True, octave_px=4)
    model = model_with(rendered, [0, 1, 2, 4])
    given = run(model, refinement=[RefinementFigures(passes=[], registrations=[OUT, coarse])])
    poses = model_poses(given.registered().models[0])
    assert LOST in poses
    for name, pose in model_poses(model).items():
        np.testing.assert_allclose(poses[name].centre, pose.centre, atol=1e-12)
        np.testing.assert_allclose(poses[name].rotation, pose.rotation, atol=1e-12)


def test_the_model_with_most_photos_comes_first_with_its_figures_and_its_check(rendered, run):
    given = run(model_with(rendered, [0, 1, 2], every=6), model_with(rendered, [0, 1, 2]))
    made = given.registered()
    assert [len(registered(each)) for each in made.models] == [5, 3]
    assert row_of(made.refinement[0]) is not None and made.refinement[1] == REFINED
    assert [check and check.verdict for check in made.mapping.checks] == ["amber", "green"]
    colours = {tuple(point.color) for point in made.models[0].points3D.values()}
    assert len(colours) > 10


@pytest.mark.parametrize(("before", "held"), [(REFINED, None), (TAKEN_OUT, 3)])
def test_a_photo_of_another_place_gets_none_and_keeps_the_reason_it_had(
    rendered, run, before, held
):
    model = model_with(rendered, [0, 1, 2, 4])
    given = run(model, refinement=[before], photos={LOST: other_scene(0)})
    made = given.registered()
    assert [fingerprint(each) for each in made.models] == [fingerprint(model)]
    row = row_of(made.refinement[0])
    assert row is not None and row.held == held and bool(row.reason) == (held is None)


def test_pairs_that_were_found_to_be_false_say_nothing(rendered, run):
    false = [(min(name, LOST), max(name, LOST)) for name in NAMES if name != LOST]
    made = run(model_with(rendered, [0, 1, 2, 4]), false=false).registered()
    assert registered(made.models[0]) == {*NAMES} - {LOST} and made.refinement == [REFINED]


def test_a_photo_that_went_away_is_not_missed(rendered, run):
    given = run(model_with(rendered, [0, 1, 2]))
    given.given.images[3].path.unlink()
    made = given.registered()
    assert registered(made.models[0]) == {*NAMES} - {LOST}


def test_a_photo_of_a_model_that_went_away_leaves_the_models_and_is_asked_for_again(
    rendered, run, caplog
):
    given = run(model_with(rendered, [0, 1, 2, 4]))
    path = given.given.images[1].path
    content = path.read_bytes()
    path.unlink()
    assert given.registered() is given.made and "no photos were registered" in caplog.text
    path.write_bytes(content)
    assert registered(given.registered().models[0]) == {*NAMES}


def test_a_model_that_was_not_refined_takes_up_no_photo(rendered, run):
    whole, few = model_with(rendered, [0, 1, 2, 4]), model_with(rendered, [0, 1, 2], every=4)
    given = run(whole, few, refinement=[None, REFINED])
    made = given.registered()
    assert {*map(len, map(registered, made.models))} == {4} and made.refinement[0] is None
    assert fingerprint(made.models[0]) == fingerprint(whole) and LOST in registered(made.models[1])
    none = given._replace(made=dataclasses.replace(given.made, refinement=[None] * 2))
    assert none.registered() is none.made


class FakeGrow:
    """Registers the photos of a plan, one list for each call."""

    def __init__(self, rendered: Room, *plan: list[str]) -> None:
        self.views = {view.name: view for view in rendered.views}
        self.plan, self.wanted = [*plan], list[dict[str, list[str]]]()
        """Of each call, the photos to register and their partners."""

    def __call__(self, models, wanted, matches, images, **_) -> ExtendedModels:
        self.wanted.append({name: list(each.shortlist) for name, each in wanted.items()})
        new = [name for name in self.plan.pop(0) if name in wanted]
        model = models[0].with_views([*models[0].views, *(self.views[name] for name in new)])
        located = {
            name: Localization(trusted=name in new, why=None, on_surface=9, octave_px=1)
            for name in wanted
        }
        return ExtendedModels([model, *models[1:]], dict.fromkeys(new, 0), located, 1)


@pytest.mark.parametrize(
    ("plan", "asked"),
    [
        # The matches of the run are enough.
        ([["3.png", "4.png"]], []),
        # One photo is left, and is registered by its matches at full size.
        ([["3.png"], ["4.png"]], ["full 4.png"]),
        # It needs further passes.
        ([["3.png"], [], ["4.png"]], ["full 4.png", "further 4.png"]),
        # They do not help, and nothing new can be its partner.
        ([["3.png"], [], []], ["full 4.png", "further 4.png"]),
        # Without any new photo at first, further matches are made all the same.
        (
            [[], ["3.png"], [], []],
            ["full 3.png 4.png", "full 4.png", "further 4.png"],
        ),
        # A photo that further passes have registered is a new partner for a match at full size.
        (
            [[], [], ["3.png"], ["4.png"]],
            ["full 3.png 4.png", "further 3.png", "full 4.png"],
        ),
        # Further passes are made for all photos, one after the other.
        (
            [[], [], [], []],
            ["full 3.png 4.png", "further 3.png", "further 4.png"],
        ),
    ],
)
def test_more_is_matched_only_while_photos_are_lost_and_a_new_one_was_registered(
    rendered, run, monkeypatch, plan, asked
):
    told, tried, grow = [], set(), FakeGrow(rendered, *plan)
    every = all_matches(rendered)

    def match_lost(lost, registered, false, *, further) -> Mapping[Pair, PairResult]:
        """As `LostMatcher`: no pair is matched twice alike, and one photo at a time further."""
        assert not {*lost} & {*registered} and {*lost} | {*registered} == {*NAMES}
        assert {*false} == {("0.png", "1.png")}
        new = {pair for pair in every if len({*pair} & {*lost}) == 1} - {
            pair for pair, before in tried if before == further
        }
        sought = sorted({name for pair in new for name in pair} & {*lost})
        sought = sought[:1] if further else sought
        new = {pair for pair in new if {*pair} & {*sought}}
        tried.update((pair, further) for pair in new)
        if new:
            told.append(" ".join(["further" if further else "full", *sought]))
        return {pair: every[pair] for pair in new}

    monkeypatch.setattr(module, "grow", grow)
    given = run(model_with(rendered, [0, 1, 2]), false=[("0.png", "1.png")])
    made = given.registered(match_lost)
    assert told == asked and grow.plan == [] and len(grow.wanted) == len(plan)
    assert registered(made.models[0]) == {*NAMES[:3]}.union(*plan)
    assert registered(given.registered(match_lost).models[0]) == registered(made.models[0])
    assert told == asked  # the second time, the stage is there


def test_a_photo_is_located_among_the_photos_that_it_was_matched_with(rendered, run, monkeypatch):
    every = all_matches(rendered)
    few = {pair: every[pair] for pair in [("0.png", "3.png"), ("1.png", "2.png")]}
    grow = FakeGrow(rendered, [])
    monkeypatch.setattr(module, "grow", grow)
    monkeypatch.setattr(module, "believed_matches", lambda *_: few)
    run(model_with(rendered, [0, 1, 2])).registered()
    assert grow.wanted == [{"3.png": ["0.png"]}]


@pytest.mark.parametrize("refines", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_a_camera_that_no_model_has_may_be_adjusted(rendered, run, monkeypatch, refines, shared):
    own: list[bool] = []

    def grow(models, wanted, *_, **__) -> ExtendedModels:
        own.extend(each.own_camera for each in wanted.values())
        return ExtendedModels(list(models), {}, {}, 1)

    given = run(model_with(rendered, [0, 1, 2, 4]))
    cameras = dict(module.read_images(given.selected.database))
    if not shared:
        image_id, camera = cameras[LOST]
        alone = pycolmap.Camera(camera.todict())
        alone.camera_id = 99
        cameras[LOST] = (image_id, alone)
    monkeypatch.setattr(module, "read_images", lambda _: cameras)
    monkeypatch.setattr(module, "grow", grow)
    options = dataclasses.replace(given.given.options, refine_intrinsics=refines)
    given._replace(given=dataclasses.replace(given.given, options=options)).registered()
    assert own == [refines and not shared]


def test_where_no_more_matches_are_found_the_search_ends(rendered, run, monkeypatch):
    told: list[Any] = []
    monkeypatch.setattr(module, "grow", FakeGrow(rendered, []))
    given = run(model_with(rendered, [0, 1, 2]))
    given.registered(lambda *_, further: told.append(further) or {})
    assert told == [False, True]


def test_without_a_lost_photo_nothing_is_matched_and_nothing_kept(rendered, run):
    given = run(model_with(rendered, range(5)))
    assert given.registered(lambda *_, **__: pytest.fail("no photo is lost")) is given.made
    assert not (Path(given.kept.folder.path) / "stages" / "registered").exists()


@pytest.mark.parametrize(("most", "partners"), [(1, ["2.png"]), (3, ["1.png", "2.png", "4.png"])])
def test_a_photo_is_located_among_photos_with_a_place_before_others(
    rendered, run, monkeypatch, most, partners
):
    """It has most matches with photos that are lost themselves."""
    pairs = {name: (min(name, LOST), max(name, LOST)) for name in NAMES if name != LOST}
    counts = {name: all_matches(rendered)[pair].num_inliers for name, pair in pairs.items()}
    assert counts["1.png"] < counts["2.png"] < counts["0.png"] < counts["4.png"]
    grow = FakeGrow(rendered, [])
    monkeypatch.setattr(module, "grow", grow)
    monkeypatch.setattr(module, "REGISTER", RegisterLimits(shortlist=most))
    run(model_with(rendered, [1, 2])).registered()
    assert grow.wanted[0][LOST] == partners
