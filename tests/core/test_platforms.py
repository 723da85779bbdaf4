"""Laws of the programs on platforms that are not here: they lower, and take their own sizes.

Lowering is the part of compiling that needs no device. That results are equal is tested where the
ways of the platforms can be run on a CPU: tests/core/test_blocks.py for the network,
tests/core/test_ransac.py for planes, and here for the sizes of chunks.
"""

import dataclasses
import functools
import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from jax import export
from strategies import rng_of

from jaxsfm.config import PRESETS, PairShape
from jaxsfm.core import align, bundle, features, pair, ransac, relocalize, sharded, soft_matching
from jaxsfm.core.bundle_layout import Free, layout_of
from jaxsfm.core.bundle_problem import Observations, Poses, Scene
from jaxsfm.core.features import BACKBONES
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair_shape import Products
from jaxsfm.core.scores import init_scores
from jaxsfm.core.types import JoinedFeatures, Thresholds
from jaxsfm.core.vgg import Preprocessing

square_patch = compiled(align.square_patch, "radius")
PLATFORMS = ("cpu", "cuda", "tpu")
HEIGHT, WIDTH, COARSE = 128, 192, 96


def shaped(*shape: int, dtype=jnp.float32) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, dtype)


SIZE = shaped(2, dtype=jnp.int32)
IMAGE = shaped(HEIGHT, WIDTH, 3, dtype=jnp.uint8)
KEY = jax.eval_shape(lambda: jax.random.key(0))
LIMITS = Thresholds(shaped(), shaped(dtype=jnp.int32), shaped())


def parameters(backbone: str) -> dict:
    kernels = BACKBONES[backbone].kernels
    layers = {name: {"kernel": shaped(*s), "bias": shaped(s[-1])} for name, s in kernels.items()}
    return {"params": layers}


def settings_of(preset: str, **changes) -> features.Extraction:
    config = PRESETS[preset]
    fixed = features.Extraction(
        Preprocessing(1.0, (0.5, 0.5, 0.5), (0.2, 0.2, 0.2)),
        num_coarse=COARSE,
        octaves=config.octaves,
        centred=config.centred,
    )
    return fixed._replace(**changes)


@functools.cache
def described(preset: str):
    settings = settings_of(preset)
    extract = functools.partial(features.extract, settings=settings)
    return jax.eval_shape(extract, parameters("vgg16"), IMAGE, SIZE)


@functools.cache
def joined(preset: str, products: Products = "float32"):
    return jax.eval_shape(functools.partial(join_octaves, products=products), described(preset))


def extraction(settings: features.Extraction, *, learned: bool = False):
    params = parameters(settings.backbone)
    heads = jax.eval_shape(init_scores, KEY) if learned else None
    extract = functools.partial(features.extract, settings=settings)
    return lambda p, s, image, size: extract(p, image, size, scores=s), (params, heads, IMAGE, SIZE)


def matching(preset: str, products: Products = "float32"):
    match = functools.partial(pair.match_pair, shape=PRESETS[preset].pair)
    both = joined(preset, products)
    return match, (KEY, both, both, LIMITS)


def batch_of_pairs():
    mesh = sharded.device_mesh(jax.devices()[:1])
    side = jax.tree.map(lambda x: shaped(1, *x.shape, dtype=x.dtype), joined("default"))
    match = functools.partial(sharded.match_batch, mesh=mesh, shape=PRESETS["default"].pair)
    ids = shaped(1, 2, 2, dtype=jnp.uint32)
    return match, (KEY, ids, ((side, side), (side, side)), LIMITS)


def alignment():
    patch = jax.eval_shape(lambda: align.square_patch(7))
    image, xy = shaped(HEIGHT, WIDTH, 1), shaped(9, 2)
    templates = jax.eval_shape(align.make_templates, image, SIZE, xy, patch)
    return align.align, (image, SIZE, templates, xy, shaped(9, 2, 2), patch)


def templates():
    patch = jax.eval_shape(lambda: align.square_patch(7))
    return align.make_templates, (shaped(HEIGHT, WIDTH, 1), SIZE, shaped(9, 2), patch)


def soft_pair():
    image, heads = shaped(HEIGHT, WIDTH, 3), jax.eval_shape(init_scores, KEY)
    gradient = jax.value_and_grad(soft_matching.pair_loss, argnums=(0, 1))
    given = parameters("vgg16"), heads, (image, image), (SIZE, SIZE), shaped(3, 3)
    return gradient, given


def adjustment():
    photo, point = np.mgrid[:3, :40].reshape(2, -1)
    free = Free(np.arange(18).reshape(3, 6) > 6, np.ones(40, bool), np.zeros((1, 8), bool))
    layout = layout_of(photo, point, free, camera=np.zeros(3, int), model=np.ones(1, int))

    def loss(start, seen, reference):
        return bundle.pose_loss(
            bundle.adjust(start, seen, layout, scale=3.0).scene.poses, reference
        )

    scene = Scene(Poses(shaped(3, 3, 3), shaped(3, 3)), shaped(40, 4), shaped(1, 8))
    seen = Observations(shaped(120, 2), shaped(120))
    return jax.value_and_grad(loss, argnums=(0, 1)), (scene, seen, scene.poses)


def walks(variant):
    scores = [shaped(HEIGHT // s, WIDTH // s) for s in (4, 2, 1)]
    cells = shaped(4 * COARSE, dtype=jnp.int32)
    return functools.partial(relocalize.relocalize, variant=variant), (scores, cells, cells)


def planes():
    peel = functools.partial(ransac.peel_planes, shape=PRESETS["default"].pair)
    return peel, (KEY, shaped(500, 2), shaped(500, 2), shaped(500, dtype=jnp.bool_), LIMITS)


PROGRAMS = {
    "extract default": lambda: extraction(settings_of("default")),
    "extract paper": lambda: extraction(settings_of("paper")),
    "extract paper-grid": lambda: extraction(settings_of("paper", walk=features.Walk(levels=0))),
    "extract paper-learned": lambda: extraction(settings_of("paper"), learned=True),
    "extract bfloat16": lambda: extraction(settings_of("paper", bfloat16=True)),
    "extract vgg19": lambda: extraction(settings_of("paper", backbone="vgg19")),
    "extract alexnet": lambda: extraction(settings_of("paper", backbone="alexnet")),
    "store": lambda: (features.stored, (described("default"),)),
    "join octaves": lambda: (join_octaves, (described("default"),)),
    "match default": lambda: matching("default"),
    "match paper": lambda: matching("paper"),
    "match robust": lambda: matching("robust"),
    "match default, float16": lambda: matching("default", "float16"),
    "match paper, bfloat16": lambda: matching("paper", "bfloat16"),
    "match a batch": batch_of_pairs,
    "ransac": planes,
    "relocalize": lambda: walks("hard"),
    "relocalize softly": lambda: walks("soft"),
    "relocalize straight-through": lambda: walks("straight-through"),
    "soft matching and its gradient": soft_pair,
    "bundle adjustment and its gradient": adjustment,
    "templates": templates,
    "align": alignment,
}


def along(axis: tuple, tree):
    """The shapes of a tree, with a leading axis."""
    return jax.tree.map(lambda x: shaped(*axis, *x.shape, dtype=x.dtype), tree)


def any_photos(preset: str):
    extract = functools.partial(features.extract, settings=settings_of(preset))
    given = parameters("vgg16"), *along(export.symbolic_shape("photos"), (IMAGE, SIZE))
    return jax.vmap(extract, in_axes=(None, 0, 0)), given


def any_pairs(preset: str):
    match, (key, *sides, limits) = matching(preset)
    given = *along(export.symbolic_shape("pairs"), (key, *sides)), limits
    return jax.vmap(match, in_axes=(0, 0, 0, None)), given


def any_features(function):
    return function, (along(export.symbolic_shape("photos"), described("default")),)


def any_walks():
    h, w, n = export.symbolic_shape("h, w, cells")
    cells = shaped(n, dtype=jnp.int32)
    scores = [shaped(h * s, w * s) for s in (1, 2, 4)]
    return functools.partial(relocalize.relocalize, variant="hard"), (scores, cells, cells)


def any_templates():
    h, w, n = export.symbolic_shape("h, w, keypoints")
    _, (*_, patch) = templates()
    return align.make_templates, (shaped(h, w, 1), SIZE, shaped(n, 2), patch)


def any_alignment():
    make, (image, size, xy, patch) = any_templates()
    made = jax.eval_shape(make, image, size, xy, patch)
    affine = shaped(*xy.shape, 2)
    return align.align, (image, size, made, xy, affine, patch)


SYMBOLIC = {
    "extract paper": (lambda: any_photos("paper"), {"photos"}),
    "extract default": (lambda: any_photos("default"), {"photos"}),
    "store": (lambda: any_features(features.stored), {"photos"}),
    "join octaves": (lambda: any_features(jax.vmap(join_octaves)), {"photos"}),
    "match paper": (lambda: any_pairs("paper"), {"pairs"}),
    "relocalize": (any_walks, {"h", "w", "2*h", "2*w", "4*h", "4*w", "cells"}),
    "templates": (any_templates, {"h", "w", "keypoints"}),
    "align": (any_alignment, {"h", "w", "keypoints"}),
}
"""Programs that are lowered once for all sizes, and the sizes that are not known then. For
extraction and matching, the sizes of photos and of lists of cells are not among them
(docs/decisions/accelerators.md)."""


@functools.cache
def traced(make: Callable[[], tuple]):
    """A program like those of `PROGRAMS`, from which it is lowered."""
    function, given = make()
    return jax.jit(function).trace(*given)


@functools.cache
def exported(name: str) -> export.Exported:
    """One of `SYMBOLIC`, lowered for all platforms."""
    function, given = SYMBOLIC[name][0]()
    return export.export(jax.jit(function), platforms=PLATFORMS)(*given)


@pytest.mark.parametrize("name", SYMBOLIC)
def test_one_program_serves_all_batches_and_lengths(name):
    avals = exported(name).in_avals
    sizes = {str(d) for x in avals for d in x.shape if not isinstance(d, int)}
    assert sizes == SYMBOLIC[name][1]


@pytest.mark.parametrize(("height", "width", "count"), [(64, 80, 1), (48, 48, 9)])
def test_the_alignment_for_all_sizes_gives_what_that_for_one_size_gives(height, width, count):
    rng = rng_of(count)
    patch, size = square_patch(radius=7), np.int32([height, width])
    image = np.float32(rng.normal(size=(height, width, 1)))
    xy = np.float32(rng.uniform(16, 32, (count, 2)))
    affine = np.float32(np.eye(2) + rng.uniform(-0.2, 0.2, (count, 2, 2)))
    for program, function, given in (
        ("templates", align.make_templates, (image, size, xy, patch)),
        (
            "align",
            align.align,
            (image, size, align.make_templates(image, size, xy, patch), xy, affine, patch),
        ),
    ):
        for x, y in zip(exported(program).call(*given), function(*given), strict=True):
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("name", PROGRAMS)
def test_every_program_lowers_for_every_platform(name):
    text = traced(PROGRAMS[name]).lower(lowering_platforms=PLATFORMS).as_text()
    assert "func.func public @main" in text


def test_accelerators_score_all_hypotheses_of_a_plane_at_once():
    larger = PRESETS["paper"].pair.for_accelerators()
    assert larger.hypotheses_per_step * larger.steps_at_once >= larger.max_hypotheses
    samples = f"tensor<{larger.steps_at_once}x{larger.hypotheses_per_step}x3x3xf32>"
    for platform in PLATFORMS:
        text = traced(PROGRAMS["match paper"]).lower(lowering_platforms=(platform,)).as_text()
        assert (samples in text) == (platform != "cpu")


@pytest.mark.parametrize(
    ("make", "short"),
    [
        pytest.param(PROGRAMS["match default, float16"], "f16", id="float16-f16"),
        pytest.param(lambda: matching("default", "bfloat16"), "bf16", id="bfloat16-bf16"),
    ],
)
def test_accelerators_multiply_descriptors_of_16_bits_and_sum_in_float32(make, short):
    """CPUs multiply in float32, because few of them have such products."""
    for platform in PLATFORMS:
        text = traced(make).lower(lowering_platforms=(platform,)).as_text()
        operands = {
            tuple(re.findall(r"tensor<(?:\d+x)*(\w+)>", line.rpartition(" : ")[2]))
            for line in text.splitlines()
            if "stablehlo.dot_general" in line
        }
        assert ((short, short, "f32") in operands) == (platform != "cpu")
        assert all(types[2] == "f32" for types in operands)


def test_only_what_changes_no_result_differs_between_platforms():
    ours = PairShape(hypotheses_per_step=32, steps_at_once=1, fine_chunk=3)
    larger = ours.for_accelerators()
    changed = {
        name: (value, getattr(larger, name))
        for name, value in dataclasses.asdict(ours).items()
        if getattr(larger, name) != value
    }
    assert changed == {"steps_at_once": (1, 79), "fine_chunk": (3, 24)}


def views_of_one_wall(rng):
    """Joined features of two images whose cells match along a shift, with some noise."""
    rows, cols, channels = 12, 16, 24
    wall = rng.normal(size=(2 * rows, 2 * cols + 4, channels))

    def view(shift):
        fine = wall[:, shift : shift + 2 * cols] + 0.2 * rng.normal(size=(2 * rows, 2 * cols, 24))
        coarse = fine.reshape(rows, 2, cols, 2, channels).mean((1, 3))
        unit = [
            (x / np.linalg.norm(x, axis=-1, keepdims=True)).reshape(-1, channels)
            for x in (coarse, fine)
        ]
        row, col = np.mgrid[: 2 * rows, : 2 * cols]
        keypoints = np.stack([8 * col + 3.5, 8 * row + 3.5], -1).reshape(-1, 2)
        keypoints = keypoints + rng.uniform(-3, 3, keypoints.shape)
        grids = np.int32([rows, cols]), np.int32([2 * rows, 2 * cols])
        coarse, fine, keypoints = (np.float32(x) for x in (*unit, keypoints))
        return JoinedFeatures(coarse, fine, keypoints, *grids)

    return view(0), view(4)


@pytest.mark.optimized
def test_the_sizes_of_accelerators_give_the_cpus_matches_bit_for_bit():
    rng = rng_of(0)
    limits = Thresholds(jnp.float32(10), jnp.int32(26), jnp.float32(0.999))
    given = jax.random.key(1), *views_of_one_wall(rng), limits
    shape = dataclasses.replace(PRESETS["default"].pair, max_hypotheses=1000)
    ours = pair.match_pair(*given, shape=shape)
    match = jax.jit(functools.partial(pair._match_pair, shape=shape.for_accelerators()))
    assert ours.num_coarse > 100 and ours.num_inliers[0] > 100
    for x, y in zip(match(*given), ours, strict=True):
        np.testing.assert_array_equal(x, y)
