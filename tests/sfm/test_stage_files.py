"""Laws of the figures that stages leave: what is written is read again."""

import dataclasses
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from verdicts import OTHER, check_of

from jaxsfm.colmap.mapper import LOW_ANGLE_DEG, Attempt
from jaxsfm.colmap.other_camera import OtherCamera
from jaxsfm.io.typed_files import read_figures, write_figures
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.mapped_stage import VerificationFigures
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.one_pass import PassFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt
from jaxsfm.sfm.refined_stage import RefinedFigures
from jaxsfm.sfm.view_graph import Verdict

T = TypeVar("T")
NAMES = ["a b.jpg", "sub/ü.png", '"c".jpg']
PAIRS = [("a b.jpg", "sub/ü.png"), ("a b.jpg", '"c".jpg'), ("sub/ü.png", '"c".jpg')]


numbers = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(max_size=12)
verdicts = st.builds(
    Verdict,
    trusted=st.booleans(),
    edge_weight=numbers,
    rotation_error_deg=st.none() | numbers,
    reason=texts,
    rejected=st.booleans(),
)
attempts = st.builds(
    Attempt,
    mapper=st.sampled_from(["incremental", "global"]),
    initial_pair=st.none() | st.sampled_from(PAIRS),
    registered=st.lists(st.integers(0, 99), max_size=3),
)
two = dataclasses.replace(
    check_of("green"),
    alternative=OTHER,
    apart=[NAMES[:2]],
    split_groups=[NAMES[:3]],
)
checks = st.none() | st.sampled_from([check_of("green"), check_of("amber"), check_of("red"), two])
mappings = st.builds(
    MappingFigures,
    verdicts=st.dictionaries(st.sampled_from(PAIRS), verdicts),
    attempts=st.lists(attempts, max_size=3),
    checks=st.lists(checks, max_size=3),
    basis=st.sampled_from(["pairs", "order"]),
)


def written_and_read(folder: Path, value: object, kind: type[T]) -> T:
    write_figures(folder / "figures", value)
    return read_figures(folder / "figures", kind)


@settings(max_examples=30, deadline=None)
@given(mappings)
def test_figures_of_mapping_survive_a_file(tmp_path_factory, figures):
    folder = tmp_path_factory.mktemp("mapped")
    assert written_and_read(folder, figures, MappingFigures) == figures


def test_checks_of_a_mapping_survive_a_file(tmp_path):
    rejected = dict(zip(PAIRS, check_of("red").contradictions, strict=False))
    found = Checked(
        check=check_of("red"),
        rejected=rejected,
        rejection_candidates={},
        explained={PAIRS[1]},
        against={PAIRS[2], PAIRS[0]},
        components=[NAMES[:2], NAMES[2:]],
    )
    assert rejected
    assert written_and_read(tmp_path, [found, None], list[Checked | None]) == [found, None]


def test_a_check_that_was_read_has_the_verdict_that_was_written(tmp_path):
    written = [check_of("green"), None, check_of("red"), check_of("amber")]
    figures = MappingFigures(verdicts={}, attempts=[], checks=written)
    found = written_and_read(tmp_path, figures, MappingFigures)
    colours = [check and check.verdict for check in found.checks]
    assert colours == ["green", None, "red", "amber"]


def test_figures_of_refinement_survive_a_file_with_the_order_of_the_models(tmp_path):
    one = PassFigures(
        accepted=True,
        candidates=9,
        kept=8,
        dropped=1,
        added=3,
        weak_views=NAMES[:1],
        points=40,
        reprojection_error_px=0.25,
    )
    placed = RegistrationAttempt(
        name=NAMES[1], registered=True, octave_px=4, candidates=7, agreed=5, error_px=1.5, held=None
    )
    models = [
        RefinementFigures(
            passes=[one, dataclasses.replace(one, accepted=False)], registrations=[placed]
        ),
        None,
        RefinementFigures(
            passes=[],
            registrations=[],
            camera=OtherCamera(model="PINHOLE", params=[9.0] * 4, distance_px=4.5, halves_px=0.5),
        ),
    ]
    for figures in (RefinedFigures(models, [2, 0, 1]), RefinedFigures([], [])):
        assert written_and_read(tmp_path, figures, RefinedFigures) == figures


def test_figures_of_verification_survive_a_file(tmp_path):
    figures = VerificationFigures(
        verified=dict(zip(PAIRS, (30, 15, 99), strict=True)),
        angles=dict(zip(PAIRS, (0.0, 1.25, 44.5), strict=True)),
        one_place=True,
    )
    assert written_and_read(tmp_path, figures, VerificationFigures) == figures


@pytest.mark.parametrize(
    "angles, one_place, no_depth",
    [
        ((0.0, 1.25, 44.5), False, False),
        ((0.0, 1.25, 44.5), True, True),
        ((0.0, 1.25, LOW_ANGLE_DEG - 0.1), False, True),
        ((0.0, 1.25, LOW_ANGLE_DEG), False, False),
        ((0.0, 0.0, 0.0), False, False),
        ((), False, False),
    ],
)
def test_nothing_gives_depth_if_no_known_angle_does(angles, one_place, no_depth):
    """0 says that the angle is not known."""
    figures = VerificationFigures(
        verified={}, angles=dict(zip(PAIRS, angles, strict=False)), one_place=one_place
    )
    assert figures.no_depth == no_depth


def test_a_number_of_numpy_is_written_as_a_number_and_other_things_are_not(tmp_path):
    assert written_and_read(tmp_path, [np.float64(0.1), np.inf], list[float]) == [0.1, np.inf]
    with pytest.raises(TypeError, match="must be plain; got ndarray"):
        write_figures(tmp_path / "figures", [np.zeros(3)])


@pytest.mark.parametrize(
    "value, place",
    [({"verified": {}}, "angles"), ({"verified": {}, "angles": [1]}, r"\$.angles")],
)
def test_figures_of_another_kind_are_refused(tmp_path, value, place):
    with pytest.raises(ValueError, match=place):
        written_and_read(tmp_path, value, VerificationFigures)


@pytest.mark.parametrize("initial", [None, PAIRS[0]])
def test_the_first_pair_of_a_mapper_is_a_pair_again(tmp_path, initial):
    attempt = Attempt(mapper="incremental", initial_pair=initial, registered=[3, 2])
    assert written_and_read(tmp_path, [attempt], list[Attempt]) == [attempt]
