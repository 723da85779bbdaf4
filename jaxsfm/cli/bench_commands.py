"""The benchmarks' commands: `jaxsfm bench NAME`."""

from collections.abc import Callable, Mapping
from typing import Annotated, TypeVar

import tyro

from jaxsfm.bench.model_options import (
    AmbiguousOptions,
    DayNightOptions,
    LedgerOptions,
    SequenceOptions,
    StrechaOptions,
)
from jaxsfm.bench.options import BenchOptions, PlanesOptions, RecallOptions, WarpsOptions
from jaxsfm.bench.pair_options import (
    ConfidenceOptions,
    HomographyOptions,
    PosesOptions,
    TurnsOptions,
    WxbsOptions,
)
from jaxsfm.cli.run_commands import check_writable
from jaxsfm.io.threads import limit_threads

Options = TypeVar("Options", bound=BenchOptions)
Figures = TypeVar("Figures", bound=Mapping[str, object])
Unnamed = Annotated[Options, tyro.conf.arg(name="")]
"""Options that `--help` lists under "options", without the name of the parameter."""


def _run(
    bench: Callable[[Options], Figures],
    table_lines: Callable[[Figures], list[str]],
    options: Options,
) -> int:
    check_writable(options.json, "--json", (".json",))
    print("\n".join(table_lines(bench(options))))
    return 0


def ledger(bench: Unnamed[LedgerOptions]) -> int:
    """Reconstruct ordinary, ambiguous and hard sets with plain defaults, and judge the models.

    The table has a row for each set and seed: the photos in a model and the right ones, errors, the
    verdict and whether it holds, seconds, and how many times as long it took as RootSIFT.

    For example
        $ jaxsfm bench ledger --root DATA --out OUT --json ledger.json --markdown ledger.md
        $ jaxsfm bench ledger --root DATA --sets cup,ordinary-* --seeds 1 --out OUT
    """
    limit_threads(bench.threads)
    from jaxsfm.bench.ledger import bench_ledger
    from jaxsfm.bench.ledger_curve import lines_with_curve

    check_writable(bench.markdown, "--markdown", (".md",))
    return _run(bench_ledger, lines_with_curve, bench)


def strecha(bench: Unnamed[StrechaOptions]) -> int:
    """Reconstruct the Strecha sets with several methods, next to COLMAP's RootSIFT.

    For example
        $ jaxsfm bench strecha --root SETS --methods rootsift,default --json figures.json
        $ jaxsfm bench strecha --root SETS --best-pairs 5 --methods rootsift,paper-grid,paper
    """
    limit_threads(bench.threads)
    from jaxsfm.bench.strecha import bench_strecha, table_lines

    return _run(bench_strecha, table_lines, bench)


def ambiguous(bench: Unnamed[AmbiguousOptions]) -> int:
    """Reconstruct scenes that repeat themselves: right, wrong and noticed, or wrong and not?

    Synthetic scenes are rendered; sets with ground truth can be added with --root.

    For example
        $ jaxsfm bench ambiguous --sets synthetic-room,synthetic-room-poster --sizes 480
        $ jaxsfm bench ambiguous --root SETS --sets castle-P19 --sizes 600,800,1000 --seeds 3
    """
    limit_threads(bench.threads)
    from jaxsfm.bench.ambiguous import bench_ambiguous, table_lines

    return _run(bench_ambiguous, table_lines, bench)


def wxbs(bench: Unnamed[WxbsOptions]) -> int:
    """Match pairs under changes of viewpoint, illumination and season (WxBS).

    For example
        $ jaxsfm bench wxbs --root PAIRS --methods rootsift,default
    """
    from jaxsfm.bench.wxbs import bench_wxbs, table_lines

    return _run(bench_wxbs, table_lines, bench)


def homography(bench: Unnamed[HomographyOptions]) -> int:
    """Match sequences with known homographies (Oxford affine, HPatches).

    For example
        $ jaxsfm bench homography --root SEQUENCES --methods rootsift,default
    """
    from jaxsfm.bench.homography import bench_homography, table_lines

    return _run(bench_homography, table_lines, bench)


def planes(bench: Unnamed[PlanesOptions]) -> int:
    """Fit several homographies to given points (AdelaideRMF).

    For example
        $ jaxsfm bench planes --root POINTS
    """
    from jaxsfm.bench.planes import bench_planes, table_lines

    return _run(bench_planes, table_lines, bench)


def daynight(bench: Unnamed[DayNightOptions]) -> int:
    """Reconstruct day photos with one night photo: the paper's night protocol.

    The model is fitted to the reference with the day cameras only. Then the night camera is
    compared with its reference.

    For example
        $ jaxsfm bench daynight --root SETS --severity 3.25 --curves curves.png
    """
    limit_threads(bench.threads)
    from jaxsfm.bench.daynight import bench_daynight, table_lines

    check_writable(bench.curves, "--curves", (".png",))
    submission = bench.poses and bench.poses / "Aachen_eval_METHOD.txt"
    check_writable(submission, "--poses", (".txt",))
    return _run(bench_daynight, table_lines, bench)


def warps(bench: Unnamed[WarpsOptions]) -> int:
    """Compare relocalization rules on views of photos under known homographies (synthetic).

    For example
        $ jaxsfm bench warps --root PHOTOS --seeds 3
    """
    from jaxsfm.bench.warps import bench_warps, table_lines

    return _run(bench_warps, table_lines, bench)


def sequence(bench: Unnamed[SequenceOptions]) -> int:
    """Reconstruct frames of a video with known poses (7-Scenes), next to COLMAP's RootSIFT.

    With --localize, some frames are left out of the model, and localized in it.

    For example
        $ jaxsfm bench sequence --root FRAMES --every 10,2 --out OUT
        $ jaxsfm bench sequence --root FRAMES --every 2 --localize 5 --out OUT
    """
    from jaxsfm.bench.sequence import bench_sequence, table_lines

    return _run(bench_sequence, table_lines, bench)


def recall(bench: Unnamed[RecallOptions]) -> int:
    """Count the pairs of photos of one place among the pairs that retrieval chooses.

    For example
        $ jaxsfm bench recall --root PHOTOS --truth MODEL
        $ jaxsfm bench recall --root FRAMES --truth FRAMES --every 10 --strangers OTHERS
    """
    from jaxsfm.bench.recall import bench_recall, table_lines

    return _run(bench_recall, table_lines, bench)


def turns(bench: Unnamed[TurnsOptions]) -> int:
    """Match photos with copies of themselves that are turned and resized (synthetic).

    For example
        $ jaxsfm bench turns --root PHOTOS --every 10 --max-size 800
    """
    from jaxsfm.bench.turns import bench_turns, table_lines

    return _run(bench_turns, table_lines, bench)


def confidence(bench: Unnamed[ConfidenceOptions]) -> int:
    """Count how many pairs of each confidence are right: photos with known poses, altered.

    For example
        $ jaxsfm bench confidence --root SETS --max-size 800 --diagram diagram.png
    """
    from jaxsfm.bench.confidence import bench_confidence, table_lines

    check_writable(bench.diagram, "--diagram", (".png",))
    return _run(bench_confidence, table_lines, bench)


def poses(bench: Unnamed[PosesOptions]) -> int:
    """Compare relative poses from matches with known ones (ScanNet-1500, MegaDepth-1500).

    For example
        $ jaxsfm bench poses --root PHOTOS --pairs pairs_calibrated.txt --methods default
    """
    from jaxsfm.bench.poses import bench_poses, table_lines

    return _run(bench_poses, table_lines, bench)
