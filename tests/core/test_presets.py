"""The constants of the presets, as literals: others compare with them, so they are promises."""

import dataclasses

import pytest

from jaxsfm.config import PRESETS, Config, PairShape, Refinement, preset
from jaxsfm.core import coarse_to_fine, relocalize
from jaxsfm.core.octaves import OCTAVE_WEIGHT
from jaxsfm.core.types import Status

PAPER = {
    # What the paper and the authors' code say: section numbers are the paper's.
    "max_size": 1600,  # longer side, pixels; section 4
    "low_resolution": None,  # photos are described at one size
    "low_resolution_share": 1.0,
    "layers": "pool4/pool3",  # conv4 and conv3 in the paper
    "keypoints": "relocalized",  # section 3.2
    "children": 2,  # K
    "walked_levels": None,  # all: pool2, pool1 and conv1_2
    "backbone": "vgg16",
    "threshold_px": 10.0,  # section 3.3
    "min_inliers": 26,  # the code stops at 25 and fewer
    "confidence": 0.999,
    # What was added since is off.
    "enlarge": 1.0,
    "octaves": 1,
    "centred": False,
    "convolutions": "float32",
    "products": "float32",
    "aligned_octaves": 0,
    "max_rectified_planes": 0,
    "view_graph": False,
    "checked": False,
    "refinement": None,
}
PAPER_PAIR = {
    "max_planes": 5,
    "max_hypotheses": 10_000,
    "local_refits": 1,
    "two_way": False,
    "plane_rounds": 0,
    "one_to_one": "first",
    "consensus": 0,
    "hypotheses_per_step": 64,
    "coarse_columns": 128,
    "coarse_tile": 1024,
    "fine_chunk": 16,
    "compared_first": 1024,
    "steps_at_once": 2,
    "correspondences_per_cell": 2.0,
}
REFINEMENT = {
    "passes": 2,
    "radius": 7,
    "iterations": 8,
    "min_score": 0.8,
    "max_sigma_px": 0.25,
    "max_shift_px": 4.0,
    "max_error_px": 1.0,
    "min_cosine": 0.25,
    "max_stretch": 6.0,
    "most_views": 12,
    "neighbours": 16,
    "weak_octaves": 4,
    "weak_min_score": 0.6,
}
DEFAULT = PAPER | {
    "low_resolution": 800,
    "low_resolution_share": 0.625,
    "octaves": 4,
    "centred": True,
    "aligned_octaves": 4,
    "max_rectified_planes": 4,
    "view_graph": True,
    "checked": True,
    "refinement": REFINEMENT,
}
DEFAULT_PAIR = PAPER_PAIR | {
    "local_refits": 4,
    "plane_rounds": 5,
    "one_to_one": "similarity",
    "consensus": 1,
}
EXPECTED = {
    "paper": PAPER | {"pair": PAPER_PAIR},
    "default": DEFAULT | {"pair": DEFAULT_PAIR},
    "robust": DEFAULT
    | {"enlarge": 2.0, "low_resolution": None, "pair": DEFAULT_PAIR | {"local_refits": 10}},
}


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_a_preset_is_what_it_was(name):
    assert dataclasses.asdict(preset(name)) == EXPECTED[name]


def test_there_are_three_presets_and_others_are_refused_by_name():
    assert sorted(PRESETS) == sorted(EXPECTED)
    with pytest.raises(ValueError, match="default.*paper.*robust.*got 'best'"):
        preset("best")


def test_the_low_resolution_is_smaller_and_only_where_a_refinement_follows():
    default = preset("default")
    for changes, median, size in (
        ({}, 1600, 800),
        ({}, 1000, 800),
        ({}, 999, 560),
        ({}, 768, 480),
        ({}, 640, 480),
        ({}, 500, 480),
        ({"low_resolution": 300}, 640, 300),
        ({"low_resolution_share": 1.0}, 640, 800),
        ({"max_size": 600}, 600, 480),
        ({"max_size": 300}, 300, 300),
        ({"refinement": None}, 1600, 1600),
        ({"low_resolution": None}, 1600, 1600),
        ({"low_resolution": 2000, "low_resolution_share": 1.0}, 1600, 1600),
    ):
        config = dataclasses.replace(default, **changes)
        expected = dataclasses.replace(config, max_size=size, low_resolution=None)
        assert config.at_low_resolution(median) == expected, (changes, median)
    # The matches of the second look are those of a run without a first one.
    assert default.matching() == dataclasses.replace(default, low_resolution=None).matching()


def test_what_the_paper_fixes_for_all_presets():
    """Windows of 3 x 3 coarse cells, K = 2 children per axis; octaves count half each."""
    assert coarse_to_fine.RADIUS == 1 and coarse_to_fine.SIDE == 6
    assert relocalize.FACTOR == 2 and OCTAVE_WEIGHT == 0.5


@pytest.mark.parametrize(
    "name, least, message",
    [
        *((name, 1, "at least 1; got 0") for name in ("max_planes", "max_hypotheses")),
        *((name, 1, "at least 1; got 0") for name in ("hypotheses_per_step", "local_refits")),
        *((name, 1, "at least 1; got 0") for name in ("coarse_columns", "coarse_tile")),
        *(
            (name, 1, "at least 1; got 0")
            for name in ("fine_chunk", "compared_first", "steps_at_once")
        ),
        *((name, 0, "at least 0; got -1") for name in ("consensus", "plane_rounds")),
    ],
)
def test_a_pair_shape_refuses_what_is_one_too_small(name, least, message):
    PairShape(**{name: least})
    with pytest.raises(ValueError, match=f"PairShape.{name} must be {message}"):
        PairShape(**{name: least - 1})


def test_a_pair_shape_needs_room_for_correspondences():
    PairShape(correspondences_per_cell=0.01)
    for size in (0.0, -1.0):
        with pytest.raises(ValueError, match="correspondences_per_cell must be positive; got"):
            PairShape(correspondences_per_cell=size)


@pytest.mark.parametrize(
    "field, allowed, refused",
    [
        ("max_size", 48, 47),
        ("low_resolution", 48, 47),
        ("low_resolution_share", 1.0, 1.01),
        ("low_resolution_share", 0.01, 0.0),
        ("enlarge", 1.0, 0.99),
        ("octaves", 1, 0),
        ("octaves", 4, 5),
        ("aligned_octaves", 0, -1),
        ("max_rectified_planes", 0, -1),
        ("aligned_octaves", 4, 5),
        ("threshold_px", 0.01, 0.0),
        ("min_inliers", 4, 3),
        ("confidence", 0.001, 0.0),
        ("confidence", 0.9999, 1.0),
        ("children", 2, 0),
        ("children", 4, 3),
        ("walked_levels", 0, -1),
    ],
)
def test_a_config_refuses_what_lies_outside_its_range(field, allowed, refused):
    Config(**{field: allowed})
    with pytest.raises(ValueError, match=f"{field} must .*got {refused}"):
        Config(**{field: refused})


@pytest.mark.parametrize(
    "field, allowed, refused",
    [
        *((name, 1, 0) for name in ("passes", "radius", "iterations", "neighbours")),
        *((name, 0.01, 0.0) for name in ("max_sigma_px", "max_shift_px", "max_error_px")),
        ("max_stretch", 0.01, 0.0),
        ("most_views", 0, -1),
        ("weak_octaves", 0, -1),
        ("weak_octaves", 4, 5),
        *((name, 0.0, -0.01) for name in ("min_score", "min_cosine", "weak_min_score")),
        *((name, 0.99, 1.0) for name in ("min_score", "min_cosine", "weak_min_score")),
    ],
)
def test_a_refinement_refuses_what_lies_outside_its_range(field, allowed, refused):
    Refinement(**{field: allowed})
    with pytest.raises(ValueError, match=f"Refinement.{field} must .*got {refused}"):
        Refinement(**{field: refused})


def test_other_layers_are_known_ones_of_a_vgg_without_learned_keypoints():
    assert {Config(layers=name).fine_stride for name in ("conv4_3/conv3_3", "pool5/conv5_3")} == {
        4,
        16,
    }
    for name, other in (
        ("pool3/pool2", {}),
        ("conv4_3/conv3_3", {"backbone": "alexnet"}),
        ("conv4_3/conv3_3", {"keypoints": "learned"}),
    ):
        with pytest.raises(ValueError, match=f"layers .*got '{name}'"):
            Config(layers=name, **other)


def test_the_numbers_of_a_status_are_those_in_stored_files():
    assert {s.name: s.value for s in Status} == {
        "VERIFIED": 0,
        "TOO_FEW_MATCHES": 1,
        "NO_PLANE": 2,
    }
