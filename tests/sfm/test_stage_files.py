"""Laws of the figures that stages leave: what is written is read again."""

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from verdicts import OTHER, check_of

from jaxsfm.colmap.mapper import Attempt
from jaxsfm.colmap.other_camera import OtherCamera
from jaxsfm.sfm.mapping import MappingFigures
from jaxsfm.sfm.refine.one_pass import PassFigures
from jaxsfm.sfm.refine.passes import RefinementFigures
from jaxsfm.sfm.refine.weak_views import Placement
from jaxsfm.sfm.stage_files import (
    VerificationFigures,
    read_mapping,
    read_refinement,
    read_verification,
    write_mapping,
    write_refinement,
    write_verification,
)
from jaxsfm.sfm.view_graph import Verdict

NAMES = ["a b.jpg", "sub/ü.png", '"c".jpg']
PAIRS = [("a b.jpg", "sub/ü.png"), ("a b.jpg", '"c".jpg'), ("sub/ü.png", '"c".jpg')]


numbers = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(max_size=12)
verdicts = st.builds(
    Verdict,
    trusted=st.booleans(),
    strength=numbers,
    rotation_error_deg=st.none() | numbers,
    reason=texts,
    refuted=st.booleans(),
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
    told_apart=[NAMES[:3]],
)
checks = st.none() | st.sampled_from([check_of("green"), check_of("amber"), check_of("red"), two])
mappings = st.builds(
    MappingFigures,
    verdicts=st.dictionaries(st.sampled_from(PAIRS), verdicts),
    attempts=st.lists(attempts, max_size=3),
    checks=st.lists(checks, max_size=3),
    basis=st.sampled_from(["pairs", "order"]),
)


@settings(max_examples=30, deadline=None)
@given(mappings)
def test_figures_of_mapping_survive_a_file(tmp_path_factory, figures):
    folder = tmp_path_factory.mktemp("mapped")
    write_mapping(folder, figures)
    assert read_mapping(folder) == figures


def test_a_check_that_was_read_has_the_verdict_that_was_written(tmp_path):
    written = [check_of("green"), None, check_of("red"), check_of("amber")]
    write_mapping(tmp_path, MappingFigures(verdicts={}, attempts=[], checks=written))
    colours = [check and check.verdict for check in read_mapping(tmp_path).checks]
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
    placed = Placement(
        name=NAMES[1], registered=True, octave_px=4, candidates=7, agreed=5, error_px=1.5, held=None
    )
    models = [
        RefinementFigures(passes=[one, dataclasses.replace(one, accepted=False)], placed=[placed]),
        None,
        RefinementFigures(
            passes=[],
            placed=[],
            camera=OtherCamera(model="PINHOLE", params=[9.0] * 4, distance_px=4.5, halves_px=0.5),
        ),
    ]
    write_refinement(tmp_path, models, [2, 0, 1])
    assert read_refinement(tmp_path) == (models, [2, 0, 1])
    write_refinement(tmp_path, [], [])
    assert read_refinement(tmp_path) == ([], [])


def test_figures_of_verification_survive_a_file(tmp_path):
    figures = VerificationFigures(
        verified=dict(zip(PAIRS, (30, 15, 99), strict=True)),
        angles=dict(zip(PAIRS, (0.0, 1.25, 44.5), strict=True)),
    )
    write_verification(tmp_path, figures)
    assert read_verification(tmp_path) == figures


@pytest.mark.parametrize("initial", [None, PAIRS[0]])
def test_the_first_pair_of_a_mapper_is_a_pair_again(tmp_path, initial):
    attempt = Attempt(mapper="incremental", initial_pair=initial, registered=[3, 2])
    write_mapping(tmp_path, MappingFigures(verdicts={}, attempts=[attempt], checks=[]))
    assert read_mapping(tmp_path).attempts == [attempt]
