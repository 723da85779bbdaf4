"""The benchmark of accelerators runs here too; its counts are those of the programs."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core as jex

from jaxsfm.bench import accelerator, accelerator_programs
from jaxsfm.bench.accelerator_programs import Found, Stage, image_work, pair_work
from jaxsfm.config import PRESETS
from jaxsfm.core.consensus import consensus_nn
from jaxsfm.core.features import extract
from jaxsfm.core.matching import mutual_nn
from jaxsfm.core.types import DescriptorGrid, OctavePart
from jaxsfm.io.features import feature_capacity, padded_size
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
    ours = named(pair_work(SIDE, SIDE, config, Found(10, 10)), "coarse products")
    assert ours.products == pytest.approx(counted, rel=1e-6)


def test_numbers_of_sixteen_bits_need_fewer_bytes_and_the_same_products():
    config, found = PRESETS["default"], Found(4370, 22216)
    short = dataclasses.replace(config, convolutions="bfloat16", products="bfloat16")
    for ours, fewer in (
        (image_work(SIDE, SIDE, config), image_work(SIDE, SIDE, short)),
        (pair_work(SIDE, SIDE, config, found), pair_work(SIDE, SIDE, short, found)),
    ):
        assert [each.products for each in ours] == [each.products for each in fewer]
        assert sum(each.bytes for each in ours) > sum(each.bytes for each in fewer)


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


def test_agreement_counts_what_both_devices_give():
    def programs(keypoints, cells, plane):
        rest = (np.asarray(x) for x in (cells, plane, [0], [1], 1, 1, 0, 0))
        matches, found = accelerator_programs.PairMatches(*rest), Found(1, 1)
        return accelerator_programs.Programs(
            lambda: None, lambda: None, 1, 1, 0.0, 0.0, np.asarray(keypoints), matches, found
        )

    cpu = programs([[[1.0, 2.0], [3.0, 4.0]]], [[0, 0], [1, 1], [2, 2]], [0, 0, -1])
    ours = programs([[[1.0, 2.0], [3.0, 5.0]]], [[0, 0], [1, 2], [2, 2]], [0, 0, 0])
    assert accelerator_programs.agreement(ours, cpu) == (0.5, 0.5)
