"""The benchmarks' commands: `jaxsfm bench NAME`."""

from collections.abc import Callable, Mapping
from typing import TypeVar

from jaxsfm.bench.options import (
    BenchOptions,
    DayNightOptions,
    HomographyOptions,
    PlanesOptions,
    StrechaOptions,
    WarpsOptions,
    WxbsOptions,
)
from jaxsfm.cli.run_commands import check_writable

Options = TypeVar("Options", bound=BenchOptions)
Figures = TypeVar("Figures", bound=Mapping[str, object])


def _run(
    bench: Callable[[Options], Figures],
    table_lines: Callable[[Figures], list[str]],
    options: Options,
) -> int:
    check_writable(options.json, "--json", (".json",))
    print("\n".join(table_lines(bench(options))))
    return 0


def strecha(options: StrechaOptions) -> int:
    """Reconstruct the Strecha sets with several methods, next to COLMAP's RootSIFT.

    For example
        $ jaxsfm bench strecha --root SETS --methods rootsift,default --json figures.json
    """
    from jaxsfm.bench import strecha as bench

    return _run(bench.bench_strecha, bench.table_lines, options)


def wxbs(options: WxbsOptions) -> int:
    """Match pairs under changes of viewpoint, illumination and season (WxBS).

    For example
        $ jaxsfm bench wxbs --root PAIRS --methods rootsift,default
    """
    from jaxsfm.bench import wxbs as bench

    return _run(bench.bench_wxbs, bench.table_lines, options)


def homography(options: HomographyOptions) -> int:
    """Match sequences with known homographies (Oxford affine, HPatches).

    For example
        $ jaxsfm bench homography --root SEQUENCES --methods rootsift,default
    """
    from jaxsfm.bench import homography as bench

    return _run(bench.bench_homography, bench.table_lines, options)


def planes(options: PlanesOptions) -> int:
    """Fit several homographies to given points (AdelaideRMF).

    For example
        $ jaxsfm bench planes --root POINTS
    """
    from jaxsfm.bench import planes as bench

    return _run(bench.bench_planes, bench.table_lines, options)


def daynight(options: DayNightOptions) -> int:
    """Reconstruct day photos with one night photo: the paper's night protocol.

    The night camera is compared with the reference after a similarity from the day cameras.

    For example
        $ jaxsfm bench daynight --root SETS --severity 3.25 --methods rootsift,default
    """
    from jaxsfm.bench import daynight as bench

    return _run(bench.bench_daynight, bench.table_lines, options)


def warps(options: WarpsOptions) -> int:
    """Compare relocalization rules on views of photos under known homographies (synthetic).

    For example
        $ jaxsfm bench warps --root PHOTOS --seeds 3
    """
    from jaxsfm.bench import warps as bench

    return _run(bench.bench_warps, bench.table_lines, options)
