"""Laws of one photo in a finished model, on the rendered room."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from room_scene import Room, camera, exact_model, images_of, other_scene
from test_weak_views import NIGHT, NIGHT_NAME, night_matches

from jaxsfm.colmap.model import Model
from jaxsfm.config import Refinement
from jaxsfm.sfm.refine.fixed_structure import NO_MATCHES, FixedStructure
from jaxsfm.sfm.refine.pose_uncertainty import PoseUncertainty
from jaxsfm.sfm.register import locate_view
from jaxsfm.sfm.register.locate_view import Localization, locate


def known(scene: Room) -> Model:
    """The exact model without the view that is to be found."""
    use = scene.visible.copy()
    use[:, NIGHT] = False
    return exact_model(scene, use=use).part(set(scene.images) - {NIGHT_NAME})[0]


def found(
    scene: Room, *, right: int = 6, wrong: int = 18, own_camera=False, focal=1.0
) -> Localization:
    unknown = camera()
    unknown.params = [*(focal * np.asarray(unknown.params[:2])), *unknown.params[2:]]
    image = dataclasses.replace(
        scene.views[NIGHT], rotation=np.eye(3), centre=np.zeros(3), camera=unknown
    )
    return locate(
        image,
        FixedStructure(known(scene), images_of(scene), Refinement()),
        night_matches(scene, right=right, wrong=wrong),
        own_camera=own_camera,
    )


def errors(located: Localization, scene: Room) -> tuple[float, float]:
    """Of centre and rotation (degrees)."""
    assert located.view is not None
    truth = scene.views[NIGHT]
    turn = located.view.rotation @ truth.rotation.T
    degrees = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(located.view.centre - truth.centre)), float(degrees)


def test_a_few_right_matches_are_enough_and_the_error_is_as_expected(rendered):
    located = found(rendered)
    assert located.trusted and located.why is None
    position, degrees = errors(located, rendered)
    assert position < 0.01 and degrees < 0.1
    assert located.centre_error and located.rotation_error_deg
    assert position < 5 * located.centre_error and degrees < 5 * located.rotation_error_deg
    assert located.centre_error < 0.01 and located.rotation_error_deg < 0.1


def test_doubt_counts_patches_of_the_octave_that_the_photo_was_aligned_in(rendered, monkeypatch):
    sides = []

    def doubt(view, points, xy, error_px, side, *, focal):
        sides.append(side)
        return PoseUncertainty(0.1, 0.2)

    monkeypatch.setattr(locate_view, "pose_uncertainty", doubt)
    located = found(rendered)
    assert located.octave_px
    assert sides == [located.octave_px * (2 * Refinement().radius + 1)]
    assert (located.centre_error, located.rotation_error_deg) == (0.1, 0.2)


@pytest.mark.parametrize(
    ("on_surface", "why"),
    [
        (locate_view.MIN_RESECTION_POINTS - 1, "a pose needs"),
        (locate_view.MIN_RESECTION_POINTS, "no pose agrees"),
    ],
)
def test_a_photo_without_a_pose_is_told_what_was_missing(rendered, on_surface, why):
    matches = night_matches(rendered, right=6, wrong=18).matches
    assert why in (locate_view.nowhere(on_surface, matches).why or "")
    assert "no plane in common" in (locate_view.nowhere(on_surface, {}).why or "")


@pytest.mark.parametrize(
    ("best", "share", "why"),
    [
        (0.5, 0.001, "at most 0.1 % of the points that it would show there (needed: 5 %)"),
        (2.5, 0.9, "leaves 2.50 px of uncertainty (at most 1)"),
    ],
)
def test_a_small_photos_pose_that_is_not_trusted_says_what_was_missing(best, share, why):
    """It is not searched around."""
    pose = SimpleNamespace(
        best=SimpleNamespace(uncertainty_px=best), stands_out=None, searched=False, share=share
    )
    assert why in locate_view._doubtful(pose, 12, 30)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("best", "stands_out", "why"),
    [
        (None, None, "alignment finds 3 of the 40 points that it would show there (needed: 30)"),
        (
            0.5,
            None,
            "does not stand out (needed: 5 times as many points as beside it, in 20 patches)",
        ),
        (0.5, 2.5, "leaves 2.50 px of uncertainty (at most 2)"),
        (0.5, 1.5, "alignment finds another pose, which most of these matches contradict"),
    ],
)
def test_a_pose_that_is_not_trusted_says_what_was_missing(best, stands_out, why):
    first, second = (each and SimpleNamespace(uncertainty_px=each) for each in (best, stands_out))
    pose = SimpleNamespace(
        best=first, stands_out=second, searched=True, agreed=3, candidates=40, share=0.0
    )
    assert why in locate_view._doubtful(pose, 12, 30)  # pyright: ignore[reportArgumentType]


def test_an_unknown_focal_length_is_found_and_leaves_more_doubt(rendered):
    sure, unsure = found(rendered), found(rendered, right=60, own_camera=True, focal=1.2)
    assert unsure.trusted and unsure.view is not None
    at, expected = unsure.view.camera.mean_focal_length(), camera().mean_focal_length()
    assert at == pytest.approx(expected, rel=0.01)
    assert sure.centre_error and unsure.centre_error
    assert sure.centre_error < unsure.centre_error < 0.05
    assert errors(unsure, rendered)[0] < 5 * unsure.centre_error
    assert sure.uncertainty_px and unsure.uncertainty_px
    assert 1.05 * sure.uncertainty_px < unsure.uncertainty_px


def test_a_pose_that_the_photo_does_not_show_is_not_trusted(rendered):
    """Its matches agree, its pixels are another scene's."""
    elsewhere = rendered._replace(images=rendered.images | {NIGHT_NAME: other_scene(0)})
    few = found(elsewhere)
    assert few.view is None and 6 <= few.inliers < 30 and few.why
    located = found(elsewhere, right=20)
    assert not located.trusted and located.view is not None
    assert located.why and "alignment finds" in located.why
    assert errors(located, rendered)[0] < 0.5 and located.octave_px is None


def test_too_few_matches_are_no_pose_and_are_counted(rendered):
    located = found(rendered, right=1, wrong=0)
    assert located.view is None and located.on_surface == 4
    assert located.why and located.why.startswith("4 matches lie on the surface")
    assert "no plane in common" in (found(rendered, right=0, wrong=0).why or "")


def test_a_part_of_a_model_is_what_its_views_see(rendered):
    tracks = exact_model(rendered).tracks
    smaller, rows = exact_model(rendered).part({"0.png", "3.png"})
    views, part = smaller.views, smaller.tracks
    assert [view.name for view in views] == ["0.png", "3.png"]
    seen = rendered.visible[:, [0, 3]]
    assert len(part.points) == seen.any(1).sum() and len(part.xy) == seen.sum()
    np.testing.assert_array_equal(tracks.points[rows], part.points)
    for k, view in enumerate(views):
        own = part.view == k
        at = view.project(part.points[part.point[own]])[0]
        np.testing.assert_allclose(at, part.xy[own], atol=1e-6)


def test_no_view_is_no_pose(rendered):
    part, _ = exact_model(rendered).part(set())
    nothing = FixedStructure(part, images_of(rendered), Refinement())
    located = locate(rendered.views[NIGHT], nothing, NO_MATCHES, own_camera=False)
    assert located.view is None and located.why
