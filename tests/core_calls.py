"""A small call of every public function of the core, for laws that hold for all of them.

Arguments are numpy arrays of 32 bits and fewer, so that they are the same whatever JAX counts in.
"""

import functools
import importlib
import inspect
import pkgutil
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from compiled import compiled
from strategies import rng_of, unit_rows

import jaxsfm.core
from jaxsfm.config import PRESETS
from jaxsfm.core import (
    alexnet,
    align,
    band,
    blocks,
    border,
    bundle,
    bundle_layout,
    bundle_problem,
    bundle_step,
    cameras,
    consensus,
    grid,
    interpolate,
    lanes,
    levenberg_marquardt,
    losses,
    matching,
    naive,
    night,
    numerics,
    octaves,
    pair,
    planes,
    ransac,
    relocalize,
    retrieval,
    schur,
    scores,
    sharded,
    soft_matching,
    vgg,
    views,
    winograd,
)
from jaxsfm.core import coarse_to_fine as c2f
from jaxsfm.core import features as dense
from jaxsfm.core import homography as hg
from jaxsfm.core.features import BACKBONES
from jaxsfm.core.types import (
    Correspondences,
    DenseFeatures,
    DescriptorGrid,
    JoinedFeatures,
    Levels,
    OctavePart,
    Planes,
    Thresholds,
)


class Call(NamedTuple):
    """A function with its settings bound, and arguments for it."""

    function: Callable
    args: tuple
    coordinates: tuple[int, ...] = ()
    """Which leaves of the result are coordinates."""
    features: tuple[int, ...] = ()
    """Which arguments are features, whose floating point numbers may have 16 bits."""
    slow: bool = False
    """Compiling it takes seconds."""
    traced: bool = False
    """It is only traced, because compiling it takes long and its parts are called themselves."""


WITHOUT_ARRAYS = {
    "bundle_layout.is_formed",
    "bundle_layout.layout_of",
    "bundle_layout.room_for",
    "cameras.intrinsics_of",
    "consensus.weights",
    "octaves.octave_capacity",
    "panorama.panorama_directions",
    "panorama.panorama_pixels",
    "panorama.rows_per_pixel",
    "scores.heads_of",
    "sharded.device_mesh",
    "sharded.pick",
    "vgg.init_shapes",
    "vgg.layers_of",
}
"""Public functions that compute no arrays."""


def public_functions() -> set[str]:
    """module.function for every public function that a module of the core defines."""
    found = set()
    for info in pkgutil.iter_modules(jaxsfm.core.__path__):
        module = importlib.import_module(f"jaxsfm.core.{info.name}")
        for name, value in vars(module).items():
            own = getattr(value, "__module__", None) == module.__name__
            if own and callable(value) and not inspect.isclass(value) and name[0] != "_":
                found.add(f"{info.name}.{name}")
    return found


def _floats(seed: int, *shape: int, scale: float = 1.0) -> np.ndarray:
    return (scale * rng_of(seed).normal(size=shape)).astype(np.float32)


def _like(seed: int, shapes) -> dict:
    """Parameters of a network, of a size that keeps its maps at about 1."""
    rng = rng_of(seed)

    def draw(leaf):
        inputs = max(int(np.prod(leaf.shape[:-1])), 1) if leaf.ndim > 1 else 1e4
        x = rng.standard_normal(leaf.shape, np.float32)
        return x * np.float32((2 / inputs) ** 0.5)

    return jax.tree.map(draw, shapes)


ROWS, COLS = 6, 8
"""Of the coarse grid; the fine one has twice as many."""
SIZE = np.asarray([16 * ROWS, 16 * COLS], np.int32)
H = np.asarray([[1.02, 0.01, 3.0], [-0.02, 0.98, 2.0], [1e-5, 2e-5, 1.0]], np.float32)
"""Between two images of this size."""
THRESHOLDS = Thresholds(np.float32(10), np.int32(26), np.float32(0.999))
KEY = jax.random.key(7)


def _moved(xy: np.ndarray) -> np.ndarray:
    image = np.column_stack([xy, np.ones(len(xy), np.float32)]) @ H.T
    return image[:, :2] / image[:, 2:]


def _keypoints() -> np.ndarray:
    row, col = np.mgrid[: 2 * ROWS, : 2 * COLS].reshape(2, -1)
    return (8 * np.stack([col, row], -1) + rng_of(1).integers(0, 8, (row.size, 2))).astype(
        np.float32
    )


def _joined(side: int) -> JoinedFeatures:
    """Two images whose cells look alike; the keypoints of the second are moved by `H`."""
    rng, n = rng_of(2), ROWS * COLS
    coarse, fine, xy = unit_rows(rng, n, 8), unit_rows(rng, 4 * n, 6), _keypoints()
    part = OctavePart(
        unit_rows(rng, 12, 3),
        rng.integers(0, 12, (n, 4)).astype(np.int32),
        np.full((n, 4), 0.25, np.float32),
    )
    if side:
        xy = _moved(xy) + _floats(3, *xy.shape)
    sizes = (np.asarray([k * ROWS, k * COLS], np.int32) for k in (1, 2))
    return JoinedFeatures(coarse, fine, xy, *sizes, () if side else (part,))


def _dense() -> DenseFeatures:
    rng, n = rng_of(4), ROWS * COLS
    coarse, fine = (tuple(unit_rows(rng, k, 5) for k in (m, m // 4)) for m in (n, 4 * n))
    sizes = (np.asarray([k * ROWS, k * COLS], np.int32) for k in (1, 2))
    return DenseFeatures(coarse, fine, _keypoints(), *sizes)


def _levels() -> Levels:
    h, w = SIZE
    maps = (_floats(k, 1, h >> k, w >> k) ** 2 for k in range(3))
    return Levels(tuple(maps), _floats(3, 1, h // 8, w // 8, 5), _floats(4, 1, h // 16, w // 16, 7))


def _walk_maps() -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    row, col = (x.astype(np.int32).ravel() for x in np.mgrid[:ROWS, :COLS])
    return [_floats(k, ROWS * 2**k, COLS * 2**k) ** 2 for k in (1, 2, 3)], row, col


def _pyramid(seed: int) -> list[np.ndarray]:
    """Three maps below the fine cells."""
    return [_floats(seed + k, 2 * ROWS << k, 2 * COLS << k, 4) for k in (1, 2, 3)]


def _walks(seed: int) -> relocalize.WalkProbabilities:
    p = np.abs(_floats(seed, 5, 4, 4))
    start = rng_of(seed).integers(0, 900, (5, 2)).astype(np.int32)
    return relocalize.WalkProbabilities(p / p.sum((1, 2), keepdims=True), start)


def _cameras() -> tuple[np.ndarray, ...]:
    k = np.asarray([[900, 0, 400], [0, 900, 300], [0, 0, 1]], np.float32)
    rotation = np.linalg.qr(np.eye(3) + _floats(5, 3, 3, scale=0.1))[0].astype(np.float32)
    return k, k, rotation, _floats(6, 3)


def _adjusted() -> tuple:
    """Three photos of a camera beside each other, and twelve points before them; one pose and some
    of the intrinsics are held."""
    points = _floats(5, 12, 4, scale=0.3) + np.float32([0, 0, 3, 0.6])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    turns = np.stack([np.eye(3, dtype=np.float32)] * 3)
    poses = bundle_problem.Poses(turns, np.float32([[0, 0, 0], [-1, 0, 0], [-2, 0.5, 0]]))
    params, model = cameras.intrinsics_of(["RADIAL"], [[900.0, 400.0, 300.0, 0.01, 0.001]])
    scene = bundle_problem.Scene(poses, points, params.astype(np.float32))
    free = bundle_layout.Free(
        np.arange(18).reshape(3, 6) > 5, np.arange(12) > 1, np.arange(8)[None] % 3 == 0
    )
    photo, point = np.mgrid[:3, :12].reshape(2, -1)
    layout = bundle_layout.layout_of(photo, point, free, camera=np.zeros(3, int), model=model)
    seen = (points[:, :3] + poses.translations[:, None] * points[:, 3:]) @ _cameras()[0].T
    xy = (seen[..., :2] / seen[..., 2:] + _floats(6, 3, 12, 2)).reshape(-1, 2)
    weight = np.abs(_floats(7, 36)) + np.float32(0.1)
    problem = bundle_problem.Problem(layout, xy[None], weight[None], np.float32(0.01))
    return scene, bundle_problem.Observations(xy, weight), problem


def _eliminated(scene, problem) -> tuple:
    """The quadratic model and its factor, with any numbers."""

    def made(scene, problem):
        model = bundle_problem.normal(scene, problem, "huber", exact=False)
        return model, schur.factor(model, problem.layout, damping=0.1, tolerance=0.1)

    model, factor = jax.tree.map(
        lambda x: np.ones(x.shape, x.dtype) if x.dtype == bool else _floats(8, *x.shape),
        jax.eval_shape(made, scene, problem),
    )
    return model, factor._replace(layout=problem.layout)


def _pair_shape(preset: str):
    return PRESETS[preset].pair


def _aligned(seed: int) -> tuple:
    image, size = 120 + _floats(seed, 40, 44, 1, scale=20), np.asarray([40, 44], np.int32)
    patch = compiled(align.square_patch, "radius")(radius=3)
    return image, size, _floats(seed + 1, 6, 2) + np.float32(20), patch


def _templates() -> align.Templates:
    return jax.device_get(align.make_templates(*_aligned(0)))


def _settings(octaves: int, backbone: str) -> dense.Extraction:
    preprocessing = vgg.Preprocessing(1.0, (123.0, 117.0, 104.0), (60.0, 60.0, 60.0))
    return dense.Extraction(preprocessing, 16, octaves=octaves, backbone=backbone, centred=True)


def _parameters(backbone: str) -> dict:
    shapes = {
        name: {
            "kernel": jax.ShapeDtypeStruct(kernel, np.float32),
            "bias": jax.ShapeDtypeStruct(kernel[3:], np.float32),
        }
        for name, kernel in BACKBONES[backbone].kernels.items()
    }
    return {"params": _like(0, shapes)}


def _photo(*shape: int) -> np.ndarray:
    return rng_of(9).integers(0, 256, (*shape, 3)).astype(np.uint8)


def _layers() -> list[blocks.Layer]:
    return [
        blocks.Layer(_floats(k, 3, 3, 4, 4, scale=0.2), _floats(k, 4, scale=0.1)) for k in (1, 2)
    ]


def _maps() -> tuple[np.ndarray, np.ndarray]:
    return _floats(0, 2, 20, 24, 4), np.asarray([[17, 24], [20, 19]], np.int32)


def _head() -> scores.Head:
    return scores.Head(_floats(0, 4, 3), _floats(1, 3), _floats(2, 3), _floats(3, 8, 8))


def _vocabulary() -> retrieval.Vocabulary:
    return retrieval.Vocabulary(_floats(0, 6), _floats(1, 6, 4), _floats(2, 3, 4))


def _rows(seed: int, n: int = 40, c: int = 6) -> np.ndarray:
    return unit_rows(rng_of(seed), n, c)


def _matched() -> Correspondences:
    xy = _keypoints()
    return Correspondences(xy, _moved(xy), np.arange(len(xy)) % 5 > 0)


def _unit_square() -> tuple[np.ndarray, np.ndarray]:
    """Points in normalised coordinates, and their images under a map near the identity."""
    xy = _floats(0, 24, 2)
    return xy, xy * np.float32(1.1) + np.float32(0.05) + _floats(1, 24, 2, scale=1e-3)


def _four() -> tuple[np.ndarray, ...]:
    square = np.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    return tuple(square + _floats(k, 7, 4, 2, scale=0.2) for k in (0, 1))


def _grids() -> tuple[DescriptorGrid, DescriptorGrid]:
    a, b = _joined(0), _joined(1)
    return (
        DescriptorGrid(a.coarse, a.coarse_grid, a.coarse_parts),
        DescriptorGrid(b.coarse, b.coarse_grid),
    )


def _score_of_rows(a, b):
    def scores(start):
        return matching.similarity(jax.lax.dynamic_slice_in_dim(a, start, 10), b)

    return matching.scan_mutual(scores, 40, 40, tile=10)


def _sharded_pairs() -> tuple:
    mesh = _mesh()
    sides = jax.tree.map(lambda x: np.asarray(x)[None], (_joined(0), _joined(1)))
    shape = _pair_shape("paper")
    return functools.partial(sharded.match_batch, mesh=mesh, shape=shape), (
        KEY,
        np.asarray([[[1, 2]]], np.uint32),
        (sides,),
        THRESHOLDS,
    )


def _mesh():
    return sharded.device_mesh(jax.local_devices()[:1])


def _images() -> tuple[np.ndarray, np.ndarray]:
    return _photo(1, 64, 64), np.asarray([[60, 50]], np.int32)


def _bind(function, **settings):
    return functools.partial(function, **settings) if settings else function


def calls() -> dict[str, Call]:
    """name -> call. Before a bracket the name is module.function."""
    maps, row, col = _walk_maps()
    layers, (x, size) = _layers(), _maps()
    f0, f1 = _joined(0), _joined(1)
    xy0, xy1 = _unit_square()
    h = np.linalg.inv(H).astype(np.float32)
    hs = np.stack([np.eye(3, dtype=np.float32) * 0.6, np.eye(3, dtype=np.float32) * 0.5])
    few = _matched()
    reach = np.float32(0.1)
    n = np.int32
    windows = np.asarray(
        rng_of(0).integers(-1, 4 * ROWS * COLS, (ROWS * COLS, c2f.SIDE**2)), np.int32
    )
    cells = rng_of(1).integers(0, 40, (60, 2)).astype(np.int32)
    fine_cells = rng_of(3).integers(0, 2 * ROWS, (60, 4)).astype(np.int32)
    squared = _floats(2, 5, 16, 16) ** 2
    image, image_size, at, patch = _aligned(0)
    affine = np.eye(2, dtype=np.float32) + _floats(4, 6, 2, 2, scale=0.1)
    f = _floats(8, 3, 3)
    vgg16 = _parameters("vgg16")
    learned = compiled(scores.init_scores, "hidden")(KEY, hidden=3)
    photo = _photo(64, 64).astype(np.float32)
    one = np.float32(1)
    soft = {"temperature": 0.7}
    rgb, rgb_size = _photo(64, 64), np.asarray([60, 50], np.int32)
    scene, seen, adjusted = _adjusted()
    numbers, fisheye, ray = _floats(3, 10, 9), np.float32(np.arange(9) % 2), _floats(4, 3, 9) + 3
    layout, steps = adjusted.layout, (_floats(8, 21, scale=0.1), _floats(9, 12, 3, scale=0.1))
    quadratic, made = _eliminated(scene, adjusted)
    tiles = np.float32(9) * np.eye(4, dtype=np.float32)[None].repeat(3, 0), _floats(4, 3, 4, 4)
    table = {
        "align.square_patch": Call(lambda: align.square_patch(2), (), (0,)),
        "interpolate.sample": Call(interpolate.sample, (image, image_size, at)),
        "interpolate.sample_linear": Call(interpolate.sample_linear, (image, image_size, at)),
        "interpolate.pixels": Call(
            _bind(interpolate.pixels, dtype=np.float32), (image, image_size, np.int32(at))
        ),
        "interpolate.slopes": Call(
            _bind(interpolate.slopes, dtype=np.float32), (image, image_size, np.int32(at))
        ),
        "align.make_templates": Call(align.make_templates, (image, image_size, at, patch)),
        "align.align": Call(
            align.align, (image, image_size, _templates(), at, affine, patch), (0, 2), (0,)
        ),
        "blocks.clear_padding": Call(blocks.clear_padding, (x, size)),
        "blocks.rounded": Call(lambda x: blocks.rounded(x, True), (x,)),
        "blocks.conv": Call(blocks.conv, (x, layers[0])),
        "blocks.conv[bfloat16]": Call(_bind(blocks.conv, bfloat16=True), (x, layers[0])),
        "blocks.pool": Call(blocks.pool, (x, size)),
        "blocks.convolve": Call(blocks.convolve, (x, size, layers)),
        "blocks.scores_and_pool": Call(
            _bind(blocks.scores_and_pool, large=True), (x, size, layers)
        ),
        "bundle.adjust": Call(
            _bind(bundle.adjust, scale=5.0, steps=5), (scene, seen, layout), (0, 1, 2), traced=True
        ),
        "bundle.minimised": Call(
            bundle.minimised,
            (scene, seen, layout, np.float32(5), n(5), np.float32(1e-3), None),
            (0, 1, 2),
            traced=True,
        ),
        "band.band_factor": Call(band.band_factor, tiles),
        "band.band_solve": Call(band.band_solve, (band.BandFactor(*tiles), _floats(5, 3, 4))),
        "border.beside_of": Call(border.beside_of, (quadratic, layout)),
        "border.corner_of": Call(border.corner_of, (quadratic, layout)),
        "border.eliminated": Call(
            lambda e: border.eliminated(e, lambda x: 2 * x), (_floats(6, 5, 3),)
        ),
        "border.without_inner": Call(
            border.without_inner, (_floats(6, 5, 3), _floats(7, 5, 3), _floats(8, 3, 3))
        ),
        "border.with_border": Call(
            lambda *x: border.with_border(
                border.Border(*x[:3]), lambda y: 2 * y, lambda y: 3 * y, x[3]
            ),
            (_floats(6, 5, 3), _floats(7, 5, 3), _floats(8, 4, 3, 3), _floats(9, 8)),
        ),
        "bundle.problem_of": Call(_bind(bundle.problem_of, scale=5.0), (seen, layout), (15,)),
        "bundle.frame_held": Call(bundle.frame_held, (scene.poses,)),
        "bundle.relative_to_first": Call(bundle.relative_to_first, (scene.poses,), (0, 1)),
        "bundle.pose_loss": Call(
            bundle.pose_loss, (scene.poses, scene.poses._replace(translations=_floats(9, 3, 3)))
        ),
        "bundle.triangulated": Call(
            bundle.triangulated, (scene.poses, scene.params, seen, layout), (0,)
        ),
        "bundle_problem.cost": Call(_bind(bundle_problem.cost, loss="cauchy"), (scene, adjusted)),
        "bundle_problem.normal": Call(
            _bind(bundle_problem.normal, loss="cauchy", exact=False), (scene, adjusted)
        ),
        "bundle_problem.normal[exact]": Call(
            _bind(bundle_problem.normal, loss="huber", exact=True), (scene, adjusted), slow=True
        ),
        "bundle_problem.slope_of": Call(
            _bind(bundle_problem.slope_of, loss="cauchy"), (scene, adjusted)
        ),
        "bundle_problem.robust": Call(
            _bind(bundle_problem.robust, loss="huber"), (np.abs(_floats(3, 9)), one)
        ),
        "bundle_layout.places": Call(bundle_layout.places, (layout,)),
        "bundle_layout.gathered": Call(bundle_layout.gathered, (_floats(3, 3, 9), layout)),
        "bundle_problem.turned": Call(bundle_problem.turned, (_floats(3, 5, 3), _floats(4, 5, 3))),
        "bundle_step.moved": Call(bundle_step.moved, (scene, layout, *steps), (0, 1, 2, 3)),
        "cameras.spread": Call(_bind(cameras.spread, dtype=np.float32), (n([0, 5]),)),
        "cameras.numbers_of": Call(cameras.numbers_of, (scene.params, layout.model), (0,)),
        "cameras.projected": Call(cameras.projected, (numbers, fisheye, ray), (0,)),
        "cameras.slopes": Call(cameras.slopes, (numbers, fisheye, ray, _floats(5, 2, 10, 9))),
        "cameras.directions": Call(cameras.directions, (numbers, fisheye, ray[:2]), (0,)),
        "coarse_to_fine.window_cells": Call(
            c2f.window_cells, (cells[:, 0], f0.coarse_grid, f0.fine_grid)
        ),
        "coarse_to_fine.rows_of": Call(c2f.rows_of, (f0.fine, cells)),
        "coarse_to_fine.match_windows": Call(
            _bind(c2f.match_windows, chunk=16), (f0, f1, np.arange(ROWS * COLS, dtype=np.int32))
        ),
        "coarse_to_fine.candidates": Call(c2f.candidates, (windows, f0)),
        "coarse_to_fine.correspondences": Call(
            _bind(c2f.correspondences, capacity=50), (windows[:, :9],)
        ),
        "coarse_to_fine.similarities": Call(
            _bind(c2f.similarities, chunk=16), (f0, f1, cells, n(50))
        ),
        "coarse_to_fine.one_to_one": Call(
            _bind(c2f.one_to_one, num_cells=40), (cells, cells[:, 0] > 3, _floats(0, 60))
        ),
        "consensus.consensus_nn": Call(
            _bind(consensus.consensus_nn, radius=1, columns=COLS, tile=16), _grids()
        ),
        "features.dense_features": Call(
            lambda levels, size: dense.dense_features(
                [levels], size, num_coarse=64, num_fine=256, centred=True
            ),
            (_levels(), SIZE),
            (2,),
            (0,),
        ),
        "features.dense_features[grid]": Call(
            lambda levels, size: dense.dense_features(
                [levels], size, num_coarse=64, num_fine=256, walk=dense.Walk(levels=0)
            ),
            (_levels(), SIZE),
            (2,),
            (0,),
        ),
        "features.stored": Call(dense.stored, (_dense(),), (4,)),
        "features.extract": Call(
            _bind(dense.extract, settings=_settings(2, "vgg16")),
            (vgg16, rgb, rgb_size),
            (4,),
            slow=True,
        ),
        "features.extract[bfloat16]": Call(
            _bind(dense.extract, settings=_settings(1, "vgg16")._replace(bfloat16=True)),
            (vgg16, rgb, rgb_size),
            (2,),
            traced=True,
        ),
        "features.extract[alexnet]": Call(
            _bind(dense.extract, settings=_settings(1, "alexnet")),
            (_parameters("alexnet"), rgb, rgb_size),
            (2,),
            slow=True,
        ),
        "grid.cell_to_px": Call(_bind(grid.cell_to_px, stride=8), (few.xy0,), (0,)),
        "grid.cell_rows_cols": Call(lambda c: grid.cell_rows_cols(40, c), (n(7),)),
        "homography.homogeneous": Call(hg.homogeneous, (xy0,), (0,)),
        "homography.normalisation": Call(hg.normalisation, (few.xy0, np.abs(few.xy1[:, 0]))),
        "homography.apply_affine": Call(hg.apply_affine, (H, xy0), (0,)),
        "homography.adjugate": Call(hg.adjugate, (H,)),
        "homography.from_four_points": Call(hg.from_four_points, _four(), (0,)),
        "homography.orient": Call(hg.orient, (H,)),
        "homography.least_squares": Call(hg.least_squares, (xy0, xy1, np.abs(xy0[:, 0])), (0,)),
        "homography.compose": Call(hg.compose, (H, h)),
        "homography.transfer_inliers": Call(hg.transfer_inliers, (hs, xy0, xy1, reach)),
        "homography.transfer_error": Call(hg.transfer_error, (hs, xy0, xy1)),
        "homography.inliers": Call(_bind(hg.inliers, two_way=True), (hs, xy0, xy1, reach, reach)),
        "interpolate.cubic": Call(interpolate.cubic, (reach,)),
        "interpolate.noise_kept": Call(interpolate.noise_kept, (xy0, np.abs(xy0[:, 0]))),
        "interpolate.noise_summed": Call(interpolate.noise_summed, (reach, one)),
        "lanes.in_turn_on_cpus": Call(
            lambda x: jax.vmap(lanes.in_turn_on_cpus(numerics.unit))(x), (x,)
        ),
        "losses.cells_under_homography": Call(
            _bind(losses.cells_under_homography, rows=5, cols=6), (H, _floats(1, 30, 2))
        ),
        "losses.transfer_distances": Call(
            losses.transfer_distances, (H, _walks(1), _walks(2)), (0,), (1, 2)
        ),
        "losses.epipolar_distances": Call(
            losses.epipolar_distances, (f, _walks(1), _walks(2)), (0,), (1, 2)
        ),
        "losses.sampson_distances": Call(losses.sampson_distances, (f, xy0, xy1), (0,)),
        "losses.agreement": Call(
            _bind(losses.agreement, sigma=0.8), (_walks(1), _walks(2), squared)
        ),
        "losses.mean_distance": Call(
            _bind(losses.mean_distance, most=3.0), (_walks(1), _walks(2), squared)
        ),
        "losses.peakiness": Call(losses.peakiness, (_walks(1),)),
        "losses.weighted_mean": Call(losses.weighted_mean, (xy0[:, 0], np.abs(xy1[:, 0]))),
        "losses.share_within": Call(
            _bind(losses.share_within, px=1.5), (np.abs(xy0[:, 0]), xy1[:, 0] > 0)
        ),
        "matching.similarity": Call(matching.similarity, (_rows(0), _rows(1))),
        "matching.mutual": Call(matching.mutual, (cells[:40, 0], _floats(0, 40), cells[:40, 1])),
        "matching.scan_mutual": Call(_score_of_rows, (_rows(0), _rows(1))),
        "matching.mutual_nn": Call(_bind(matching.mutual_nn, tile=16), (_rows(0), _rows(1))),
        "night.blur": Call(night.blur, (photo, one)),
        "night.night": Call(night.night, (KEY, photo, np.float32(1.5)), slow=True),
        "numerics.at_least_float32": Call(numerics.at_least_float32, (xy0,)),
        "numerics.descriptor_products": Call(
            functools.partial(numerics.descriptor_products, "nc,mc->nm"),
            (_rows(0), _rows(1)),
            (0,),
            (0, 1),
        ),
        "numerics.squared_norm": Call(numerics.squared_norm, (xy0,)),
        "numerics.inverse_norm": Call(numerics.inverse_norm, (xy0,)),
        "numerics.unit": Call(numerics.unit, (xy0,)),
        "numerics.across": Call(jax.vmap(numerics.across), (_rows(0),)),
        "numerics.argmax_first": Call(_bind(numerics.argmax_first, axis=1), (xy0,)),
        "numerics.compact": Call(_bind(numerics.compact, size=30), (xy0[:, 0] > 0,)),
        "numerics.one_by_one": Call(
            lambda x: numerics.one_by_one(numerics.unit, x, batch_size=1), (x,)
        ),
        "octaves.halve": Call(octaves.halve, (photo,)),
        "octaves.blend": Call(octaves.blend, (f0.fine, f0.coarse_parts[0].cells, f0.coarse[:, :4])),
        "octaves.join_octaves": Call(octaves.join_octaves, (_dense(),), (2,)),
        "octaves.smaller": Call(lambda dense: octaves.smaller(dense, 1), (_dense(),), (4,)),
        "pair.pair_key": Call(
            lambda a, b: jax.random.key_data(pair.pair_key(KEY, a, b)), (np.uint32(5), np.uint32(3))
        ),
        "pair.tentative_matches": Call(
            _bind(pair.tentative_matches, shape=_pair_shape("paper")),
            (f0, f1, np.arange(len(f0.coarse), dtype=np.int32)),
        ),
        "pair.pair_matches": Call(
            pair.pair_matches,
            (
                cells[:, 0],
                cells,
                n(50),
                Planes(hs, n([20, 12]), n([64, 64]), cells[:, 0] % 3 - 1),
                THRESHOLDS,
            ),
        ),
        "naive.descend": Call(
            naive.descend, (_pyramid(0), _pyramid(5), fine_cells[:, :2], fine_cells[:, 2:])
        ),
        "naive.match_naively": Call(
            _bind(naive.match_naively, shape=_pair_shape("paper")),
            (KEY, (f0, f1), (_pyramid(0), _pyramid(5)), THRESHOLDS),
            (2,),
            traced=True,
        ),
        "pair.match_pair[default]": Call(
            _bind(pair.match_pair, shape=_pair_shape("default")),
            (KEY, f0, f1, THRESHOLDS),
            (2,),
            (1, 2),
            traced=True,
        ),
        "pair.match_pair[paper]": Call(
            _bind(pair.match_pair, shape=_pair_shape("paper")),
            (KEY, f0, f1, Thresholds(10.0, 26, 0.999)),
            (2,),
            (1, 2),
            slow=True,
        ),
        "retrieval.partners": Call(
            _bind(retrieval.partners, k=3, candidates=9, block=16), (_rows(0),)
        ),
        "planes.nearest_plane": Call(
            planes.nearest_plane,
            (hs, np.asarray([True, True]), Correspondences(xy0, xy1, xy0[:, 0] > -1), reach),
        ),
        "planes.settle": Call(
            _bind(planes.settle, rounds=2),
            (hs, n([20, 12]), Correspondences(xy0, xy1, xy0[:, 0] > -1), np.float32(0.5), n(4)),
            (0,),
        ),
        "retrieval.gem": Call(retrieval.gem, (_rows(0),)),
        "retrieval.vlad": Call(retrieval.vlad, (_rows(0), _vocabulary())),
        "retrieval.netvlad": Call(
            retrieval.netvlad,
            (
                _rows(0),
                retrieval.NetVLADHead(
                    _floats(0, 6, 3), _floats(1, 6, 3), _floats(2, 18, 5), _floats(3, 5)
                ),
            ),
        ),
        "ransac.sample_indices": Call(
            lambda key, count: ransac.sample_indices(key, 20, count), (KEY, n(9))
        ),
        "ransac.hypotheses_needed": Call(
            ransac.hypotheses_needed, (n(30), n(80), np.float32(0.999))
        ),
        "ransac.peel_planes": Call(
            _bind(ransac.peel_planes, shape=_pair_shape("default")),
            (KEY, *few, THRESHOLDS),
            (0,),
            slow=True,
        ),
        "relocalize.relocalize": Call(relocalize.relocalize, (maps, row, col), (0,), (0,)),
        "relocalize.relocalize[soft]": Call(
            _bind(relocalize.relocalize, variant="soft", **soft), (maps, row, col), (0,), (0,)
        ),
        "relocalize.relocalize[straight-through]": Call(
            _bind(relocalize.relocalize, variant="straight-through", **soft),
            (maps, row, col),
            (0,),
            (0,),
        ),
        "relocalize.walk": Call(_bind(relocalize.walk, **soft), (maps, row, col)),
        "relocalize.expectation": Call(relocalize.expectation, (_walks(1),), (0,), (0,)),
        "relocalize.window_positions": Call(relocalize.window_positions, (_walks(1),), (0,), (0,)),
        "scores.score": Call(scores.score, (x, _head())),
        "scores.init_scores": Call(_bind(scores.init_scores, hidden=3), (KEY,)),
        "sharded.extract_batch": Call(
            _bind(sharded.extract_batch, mesh=_mesh(), settings=_settings(1, "vgg16")),
            (vgg16, learned, *_images()),
            (2,),
            traced=True,
        ),
        "sharded.join_everywhere": Call(
            _bind(sharded.join_everywhere, mesh=_mesh()), (_dense(),), (2,)
        ),
        "sharded.match_batch": Call(*_sharded_pairs(), (2,), traced=True),
        "pair.match_pairs": Call(
            _bind(pair.match_pairs, shape=_pair_shape("default"), batch_size=2),
            (
                jax.random.split(KEY),
                *jax.tree.map(lambda x: np.stack([x, x]), (f0, f1)),
                THRESHOLDS,
            ),
            (2,),
            traced=True,
        ),
        "soft_matching.soft_mutual": Call(
            _bind(soft_matching.soft_mutual, temperature=0.05), (_rows(0), _rows(1))
        ),
        "soft_matching.fundamental_matrix": Call(
            soft_matching.fundamental_matrix, _cameras(), (0,)
        ),
        "soft_matching.soft_features": Call(
            _bind(soft_matching.soft_features, temperature=0.5),
            (vgg16, None, photo[:32, :32] / 255, n([32, 32])),
            (1,),
            (0, 2),
            traced=True,
        ),
        "soft_matching.epipolar_loss": Call(
            soft_matching.epipolar_loss, (np.abs(_floats(0, 24, 24)), xy0, xy1, f)
        ),
        "soft_matching.observed": Call(
            soft_matching.observed, ([xy0, xy1, xy1], [np.abs(_floats(0, 24, 24))] * 2), (0, 1)
        ),
        "soft_matching.pair_loss": Call(
            soft_matching.pair_loss,
            (vgg16, learned, [photo[:32, :32] / 255] * 2, [n([32, 32])] * 2, f),
            traced=True,
        ),
        "levenberg_marquardt.minimise": Call(
            _bind(levenberg_marquardt.minimise, loss="cauchy", steps=5, tolerance=1e-3),
            (scene, adjusted),
            (0, 1, 2, 3),
        ),
        "schur.factor": Call(_bind(schur.factor, damping=0.1, tolerance=0.1), (quadratic, layout)),
        "schur.solve": Call(schur.solve, (made, quadratic.slope)),
        "vgg.preprocess": Call(
            lambda rgb: vgg.preprocess(rgb, _settings(1, "vgg16").preprocessing), (rgb,)
        ),
        "vgg.VGG16": Call(
            lambda p, x, size: vgg.VGG16().apply(p, x, size),
            (vgg16, photo[None, :32, :32] / 255, n([[32, 30]])),
            traced=True,
        ),
        "vgg.VGG16.conv5": Call(
            lambda p, x, size: vgg.VGG16().apply(p, x, size, method="conv5"),
            (vgg16, photo[None, :32, :32] / 255, n([[32, 30]])),
            traced=True,
        ),
        "vgg.VGG16.walked": Call(
            lambda p, x, size: vgg.VGG16().apply(p, x, size, method="walked"),
            (vgg16, photo[None, :32, :32] / 255, n([[32, 30]])),
            traced=True,
        ),
        "vgg.VGG16.init": Call(
            vgg.VGG16().init,
            (KEY, photo[None, :32, :32] / 255, n([[32, 30]])),
            traced=True,
        ),
        "alexnet.AlexNet.init": Call(
            _bind(alexnet.AlexNet().init, method="levels"),
            (KEY, photo[None, :32, :32] / 255, n([[32, 30]])),
            traced=True,
        ),
        "views.warp_points": Call(views.warp_points, (H, xy0), (0,)),
        "views.random_homography": Call(views.random_homography, (KEY, one), (0,)),
        "views.sample_view": Call(_bind(views.sample_view, size=24), (photo, H)),
        "views.change_light": Call(views.change_light, (KEY, photo, one)),
        "views.view_pair": Call(_bind(views.view_pair, size=32), (KEY, photo), (2,), slow=True),
        "retrieval.seen": Call(retrieval.seen, (_rows(0),)),
        "retrieval.whitened": Call(retrieval.whitened, (_rows(0), _vocabulary())),
        "retrieval.nearest_centre": Call(
            retrieval.nearest_centre, (_rows(0, 40, 4), _vocabulary().centres)
        ),
        "retrieval.lloyd": Call(retrieval.lloyd, (_rows(0, 40, 4), _vocabulary().centres)),
        "retrieval.fit_vocabulary": Call(
            _bind(retrieval.fit_vocabulary, words=4, directions=3), (KEY, _rows(0))
        ),
        "winograd.conv3x3": Call(
            _bind(winograd.conv3x3, tiles=40), (photo[..., :3] / 255, _floats(0, 3, 3, 3, 5))
        ),
    }
    return dict(sorted(table.items()))
