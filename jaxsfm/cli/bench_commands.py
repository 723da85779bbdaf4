"""The benchmarks' commands: `jaxsfm bench NAME`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from jaxsfm.cli.run_commands import check_writable
from jaxsfm.errors import UserError
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice


def _listed(values: tuple[str, ...] | None) -> list[str] | None:
    """Names given by commas, blanks or both."""
    return None if values is None else [n for value in values for n in value.split(",") if n]


def _methods(values: tuple[str, ...], known: tuple[str, ...]) -> list[str]:
    from jaxsfm.bench.common import choose_methods

    return choose_methods(_listed(values) or [], known)


def _finish(lines: list[str]) -> int:
    print("\n".join(lines))
    return 0


def _keeper(json: Path | None) -> Callable[[dict[str, Any]], None]:
    from jaxsfm.bench.common import write_json

    return lambda result: None if json is None else write_json(json, result)


def _check(
    json: Path | None,
    seeds: int = 1,
    max_size: int | None = None,
    *,
    seed: int = 0,
    threads: int = -1,
) -> None:
    from jaxsfm.config import MIN_SIDE
    from jaxsfm.runs.run_options import check_seed, check_threads

    check_seed(seed)
    check_threads(threads)
    check_writable(json, "--json", (".json",))
    if seeds < 1:
        raise UserError(f"--seeds must be at least 1; got {seeds}")
    if max_size is not None and max_size < MIN_SIDE:
        raise UserError(f"--max-size must be at least {MIN_SIDE} pixels; got {max_size}")


def _of_pairs(
    bench: Callable[..., dict[str, Any]],
    root: Path,
    sets: tuple[str, ...] | None,
    methods: tuple[str, ...],
    seeds: int,
    max_size: int | None,
    network: WeightsChoice,
    json: Path | None,
) -> dict[str, Any]:
    from jaxsfm.bench.matches import PAIR_METHODS

    _check(json, seeds, max_size)
    return bench(
        root,
        sets=_listed(sets),
        methods=_methods(methods, PAIR_METHODS),
        seeds=seeds,
        max_size=max_size,
        network=network,
        progress=True,
        keep=_keeper(json),
    )


def strecha(
    *,
    root: Path,
    sets: tuple[str, ...] | None = None,
    methods: tuple[str, ...] = ("rootsift,grid,reloc,default",),
    intrinsics: Literal["known", "unknown"] = "known",
    json: Path | None = None,
    out: Path | None = None,
    network: WeightsChoice = USUAL_WEIGHTS,
    seed: int = 0,
    threads: int = -1,
) -> int:
    """Whole reconstructions of the Strecha sets, beside COLMAP's RootSIFT.

    For example
        $ jaxsfm bench strecha --root SETS --methods rootsift,default --json figures.json

    Args:
      root: Folder of the sets: SET/images/K.txt, SET/gt_dense_cameras/*.camera.
      sets: Which of them, by commas or blanks; default: all.
      methods: By commas or blanks. rootsift: COLMAP's own features. grid, reloc, learned: the
        default preset without refinement, at cell centres, relocalized by norms, by learned scores.
        default, robust: the presets; PRESET-IDEA as in bench daynight.
      intrinsics: known: the sets' K, fixed. unknown: a camera per image, guessed and refined.
      json: Write all figures here.
      out: Keep databases and models here, and go on from what is there.
      network: The network's parameters.
      seed: Of everything random.
      threads: Of COLMAP's part; -1: all.
    """
    _check(json, seed=seed, threads=threads)
    from jaxsfm.bench import strecha as bench

    result = bench.bench_strecha(
        root,
        sets=_listed(sets),
        methods=_methods(methods, bench.METHODS),
        known_intrinsics=intrinsics == "known",
        out=out,
        network=network,
        seed=seed,
        threads=threads,
        progress=True,
        keep=_keeper(json),
    )
    return _finish(bench.table_lines(result))


def wxbs(
    *,
    root: Path,
    sets: tuple[str, ...] | None = None,
    methods: tuple[str, ...] = ("rootsift,paper,default,robust",),
    seeds: int = 5,
    max_size: int | None = None,
    network: WeightsChoice = USUAL_WEIGHTS,
    json: Path | None = None,
) -> int:
    """Pairs under changes of viewpoint, illumination and season (WxBS).

    For example
        $ jaxsfm bench wxbs --root PAIRS --methods rootsift,default

    Args:
      root: Folder of the categories: CATEGORY/NAME/{01,02}.png, corrs.txt.
      sets: CATEGORY or CATEGORY/NAME, by commas or blanks; default: all.
      methods: By commas or blanks: rootsift, paper, grid (the default preset at cell centres),
        paper-learned, reloc and learned (without alignment, by norms, by learned scores), default,
        robust, and either of these without one idea: default-no-IDEA (octaves, centring, consensus,
        competition; robust-no-enlarging too), default-norm, default-learned.
      seeds: Runs of each method, with seeds 0, 1, ...
      max_size: Longer side of our working images, pixels; default: the preset's.
      network: The network's parameters.
      json: Write all figures here.
    """
    from jaxsfm.bench import wxbs as bench

    figures = _of_pairs(bench.bench_wxbs, root, sets, methods, seeds, max_size, network, json)
    return _finish(bench.table_lines(figures))


def homography(
    *,
    root: Path,
    sets: tuple[str, ...] | None = None,
    methods: tuple[str, ...] = ("rootsift,paper,default,robust",),
    seeds: int = 5,
    max_size: int | None = None,
    network: WeightsChoice = USUAL_WEIGHTS,
    json: Path | None = None,
) -> int:
    """Sequences with known homographies (Oxford affine, HPatches).

    For example
        $ jaxsfm bench homography --root SEQUENCES --methods rootsift,default

    Args:
      root: Folder of the sequences: SEQUENCE/img1.png, H1to2p (or .xml); or SEQUENCE/1.ppm, H_1_2.
      sets: Which of them, by commas or blanks; default: all.
      methods: As in bench wxbs.
      seeds: Runs of each method, with seeds 0, 1, ...
      max_size: Longer side of our working images, pixels; default: the preset's.
      network: The network's parameters.
      json: Write all figures here.
    """
    from jaxsfm.bench import homography as bench

    figures = _of_pairs(bench.bench_homography, root, sets, methods, seeds, max_size, network, json)
    return _finish(bench.table_lines(figures))


def planes(
    *,
    root: Path,
    sets: tuple[str, ...] | None = None,
    methods: tuple[str, ...] = ("paper,default",),
    seeds: int = 5,
    json: Path | None = None,
) -> int:
    """Several homographies fitted to given points (AdelaideRMF).

    For example
        $ jaxsfm bench planes --root POINTS

    Args:
      root: Folder of the points: NAME_pts.txt, rows of x1 y1 1 x2 y2 1 label.
      sets: NAMEs, by commas or blanks; default: all.
      methods: Presets, by commas or blanks.
      seeds: Runs of each, with seeds 0, 1, ...
      json: Write all figures here.
    """
    _check(json, seeds)
    from jaxsfm.bench import planes as bench
    from jaxsfm.config import PRESETS

    result = bench.bench_planes(
        root,
        sets=_listed(sets),
        methods=_methods(methods, tuple(PRESETS)),
        seeds=seeds,
        progress=True,
        keep=_keeper(json),
    )
    return _finish(bench.table_lines(result))


def daynight(
    *,
    root: Path,
    sets: tuple[str, ...] | None = None,
    methods: tuple[str, ...] = ("rootsift,paper-grid,paper,default,robust",),
    severity: float = 2.0,
    denoise: bool = True,
    jpeg: bool = True,
    network: WeightsChoice = USUAL_WEIGHTS,
    json: Path | None = None,
    seed: int = 0,
    threads: int = -1,
) -> int:
    """The paper's night protocol: day photos and one night photo, judged after a Sim3 from the day.

    For example
        $ jaxsfm bench daynight --root SETS --severity 3.25 --methods rootsift,default

    Args:
      root: Folder of scenes (SCENE/{day,night,reference}), of Strecha sets (whose images are turned
        to a synthetic night one after the other), or Aachen Day-Night.
      sets: Which scenes, by commas or blanks; default: all.
      methods: By commas or blanks: rootsift, paper-grid and paper (the paper's method at cell
        centres and relocalized), paper-learned, default, robust; ablations as in `bench wxbs`, and
        placing.
      severity: Of the synthetic night: 0: day, 1: clean, 2: noisy, 3: dark, 5: noise.
      denoise: Whether the synthetic night's camera removes noise.
      jpeg: Whether it stores JPEG.
      network: The network's parameters.
      json: Write all figures here.
      seed: Of everything random.
      threads: Of COLMAP's part; -1: all.
    """
    _check(json, seed=seed, threads=threads)
    from jaxsfm.bench import daynight as bench

    result = bench.bench_daynight(
        root,
        sets=_listed(sets),
        methods=_methods(methods, bench.METHODS),
        severity=severity,
        denoise=denoise,
        jpeg=jpeg,
        network=network,
        seed=seed,
        threads=threads,
        progress=True,
        keep=_keeper(json),
    )
    return _finish(bench.table_lines(result))


def warps(
    *,
    root: Path,
    methods: tuple[str, ...] = ("norm,learned",),
    seeds: int = 5,
    network: WeightsChoice = USUAL_WEIGHTS,
    json: Path | None = None,
) -> int:
    """Relocalization rules on views made of photos, under known homographies (synthetic).

    For example
        $ jaxsfm bench warps --root PHOTOS --seeds 3

    Args:
      root: Folder of any photos; sub-folders are included.
      methods: By commas or blanks: norm (the paper's rule), learned.
      seeds: Sets of 64 pairs of views.
      network: The network's parameters.
      json: Write all figures here.
    """
    _check(json, seeds)
    from jaxsfm.bench import warps as bench

    result = bench.bench_warps(
        root,
        methods=_methods(methods, bench.METHODS),
        seeds=seeds,
        network=network,
        progress=True,
        keep=_keeper(json),
    )
    return _finish(bench.table_lines(result))
