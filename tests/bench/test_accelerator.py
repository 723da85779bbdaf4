"""The benchmark of accelerators runs here too; its counts are those of the programs."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core as jex

from jaxsfm.bench import accelerator, accelerator_programs
from jaxsfm.bench.on_paper import (
    DEVICES,
    Found,
    Stage,
    image_work,
    in_numbers,
    pair_work,
    paper_lines,
    seconds,
)
from jaxsfm.config import PRESETS
from jaxsfm.core.consensus import consensus_nn
from jaxsfm.core.features import extract
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.types import DescriptorGrid, OctavePart
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.matching.execution import fitting_pairs
from jaxsfm.matching.extraction import extraction_settings

SIDE = 256


def products(jaxpr, times: int = 1) -> int:
    """Operations of all products and convolutions of a program; elsewhere than on CPUs."""
    total = 0
    for eqn in jaxpr.eqns:
        name, shapes = eqn.primitive.name, [v.aval.shape for v in (*eqn.invars, *eqn.outvars)]
        if name == "dot_general":
            (left, _), (batch, _) = eqn.params["dimension_numbers"]
            total += 2 * times * math.prod(shapes[-1]) * math.prod(shapes[0][k] for k in left)
        elif name == "conv_general_dilated":
            kernel = shapes[1]  # height, width, channels in, channels out
            total += 2 * times * math.prod(shapes[-1]) * math.prod(kernel[:3])
        elif name == "scan":
            total += products(eqn.params["jaxpr"].jaxpr, times * eqn.params["length"])
        elif name == "cond":  # of platforms: the last branch is that of accelerators
            total += products(eqn.params["branches"][-1].jaxpr, times)
        else:
            for value in eqn.params.values():
                if isinstance(value, jex.ClosedJaxpr):
                    total += products(value.jaxpr, times)
                elif isinstance(value, jex.Jaxpr):
                    total += products(value, times)
    return total


def named(stages: list[Stage], name: str) -> Stage:
    return next(stage for stage in stages if stage.name == name)


@pytest.mark.parametrize("name", ["paper", "default"])
def test_counted_products_of_an_image_are_those_of_its_program(weights, name):
    config = PRESETS[name]
    assert padded_size((SIDE, SIDE)) == (SIDE, SIDE), "no padding, which would count too"
    settings = extraction_settings(weights, config, feature_capacity((SIDE, SIDE)).num_coarse)
    image = jax.ShapeDtypeStruct((SIDE, SIDE, 3), jnp.uint8)
    size = jax.ShapeDtypeStruct((2,), jnp.int32)
    program = jax.make_jaxpr(lambda p, i, s: extract(p, i, s, settings=settings))
    counted = products(program(weights.params, image, size).jaxpr)
    assert image_work(SIDE, SIDE, config)[0].products == pytest.approx(counted, rel=1e-6)


@pytest.mark.parametrize("name", ["paper", "default"])
def test_counted_coarse_products_of_a_pair_are_those_of_its_program(name):
    config = PRESETS[name]
    n, shape = feature_capacity((SIDE, SIDE)).num_coarse, config.pair
    a = jax.ShapeDtypeStruct((n, 512 * config.octaves), jnp.float32)
    grid = jax.ShapeDtypeStruct((2,), jnp.int32)
    parts = tuple(
        OctavePart(
            jax.ShapeDtypeStruct((-(-n // 4**k), 512), jnp.float32),
            jax.ShapeDtypeStruct((n, 4), jnp.int32),
            jax.ShapeDtypeStruct((n, 4), jnp.float32),
        )
        for k in range(1, config.octaves)
    )

    def program(a, b, grid, parts):
        if not shape.consensus:
            return mutual_nn(a, b, tile=shape.coarse_tile)
        return consensus_nn(
            DescriptorGrid(a, grid, parts),
            DescriptorGrid(b, grid),
            radius=shape.consensus,
            columns=shape.coarse_columns,
            tile=shape.coarse_tile,
        )

    counted = products(jax.make_jaxpr(program)(a, a, grid, parts).jaxpr)
    ours = named(pair_work(SIDE, SIDE, config, Found(10, 10, 10)), "coarse products")
    assert ours.products == pytest.approx(counted, rel=1e-6)


def test_no_stage_is_faster_with_more_to_do_and_halves_are_never_slower():
    stage = Stage("any", products=1e12, others=1e10, bytes=1e9, steps=10)
    for device in DEVICES:
        least = seconds([stage], device)
        for field in ("products", "others", "bytes", "steps"):
            more = stage._replace(**{field: 1e4 * getattr(stage, field)})
            assert seconds([more], device) > least
        assert seconds([stage._replace(half=True)], device) <= least
        assert seconds([stage], device, batch=8) < least
        assert seconds([stage, stage], device) == pytest.approx(2 * least)


@pytest.mark.slow
def test_a_small_run_measures_every_preset_and_writes_its_figures(tmp_path, capsys):
    file = tmp_path / "figures.json"
    assert accelerator.main(size=(128, 128), presets=("paper",), json=file) == 0
    printed = capsys.readouterr().out
    figures = json.loads(file.read_text())
    measured = [(row["numbers"], row["what"]) for row in figures["rows"]]
    assert measured == [
        (kind, what) for kind in ("float32", "bfloat16") for what in ("images", "pairs")
    ]
    for row in figures["rows"]:
        assert row["per_second"] > 0 and 0 < row["products"] < 2 and row["megabytes"] > 0
        assert f"| {row['preset']} | {row['numbers']} | {row['what']} |" in printed
    assert figures["found"]["paper"]["tentative"] > 0
    assert all(device.name in printed for device in DEVICES)


def test_agreement_counts_what_both_devices_give():
    def programs(keypoints, cells, plane):
        rest = (np.asarray(x) for x in (cells, plane, [0], [1], 1, 1, 0, 0))
        matches, found = accelerator_programs.PairMatches(*rest), Found(1, 1, 1)
        return accelerator_programs.Programs(
            lambda: None, lambda: None, 1, 1, 0.0, 0.0, np.asarray(keypoints), matches, found
        )

    cpu = programs([[[1.0, 2.0], [3.0, 4.0]]], [[0, 0], [1, 1], [2, 2]], [0, 0, -1])
    ours = programs([[[1.0, 2.0], [3.0, 5.0]]], [[0, 0], [1, 2], [2, 2]], [0, 0, 0])
    assert accelerator_programs.agreement(ours, cpu) == (0.5, 0.5)


def test_on_paper_an_h200_matches_more_than_300_pairs_a_second_with_products_of_16_bits():
    """The counts are those of two neighbouring views at 1600 x 1200 (docs/performance.md)."""
    size, h200 = (1600, 1200), DEVICES[0]
    found = Found(coarse=4370, tentative=22216, hypotheses=21376)
    rates = {}
    for numbers in ("float32", "bfloat16"):
        config = in_numbers(PRESETS["default"], numbers)
        together = fitting_pairs(h200.memory, feature_capacity(size).num_coarse, config=config)
        rates[numbers] = 1 / seconds(pair_work(*size, config, found), h200, batch=together)
    assert h200.name == "H200" and rates["bfloat16"] > 300 > rates["float32"] > 250
    cells = next(
        line for line in paper_lines({"default": found}, size) if "bfloat16, pairs, as many" in line
    ).split(" | ")
    assert float(cells[1]) == pytest.approx(rates["bfloat16"], rel=5e-3)
