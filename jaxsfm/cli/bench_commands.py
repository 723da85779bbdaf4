"""The commands `jaxsfm bench NAME` and `jaxsfm data`: benchmarks and their public data sets."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from jaxsfm.bench.model_options import (
    AmbiguousOptions,
    DayNightOptions,
    LedgerOptions,
    SequenceOptions,
    StrechaOptions,
)
from jaxsfm.bench.options import BenchOptions, WxbsOptions
from jaxsfm.cli.arguments import Positional, check_writable, one_of
from jaxsfm.io.libraries import limit_threads

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
    from jaxsfm.bench.ledger_table import table_lines

    check_writable(bench.markdown, "--markdown", (".md",))
    return _run(bench_ledger, table_lines, bench)


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


def sequence(bench: Unnamed[SequenceOptions]) -> int:
    """Reconstruct frames of a video with known poses (7-Scenes), next to COLMAP's RootSIFT.

    With --localize, some frames are left out of the model, and localized in it.

    For example
        $ jaxsfm bench sequence --root FRAMES --every 10,2 --out OUT
        $ jaxsfm bench sequence --root FRAMES --every 2 --localize 5 --out OUT
    """
    from jaxsfm.bench.sequence import bench_sequence, table_lines

    return _run(bench_sequence, table_lines, bench)


BENCHMARKS = {
    "ledger": ledger,
    "strecha": strecha,
    "daynight": daynight,
    "ambiguous": ambiguous,
    "sequence": sequence,
    "wxbs": wxbs,
}
_Benchmark = one_of(BENCHMARKS)


def bench(result: _Benchmark) -> int:  # pyright: ignore[reportInvalidTypeForm]
    """Run a benchmark on a public data set."""
    return result


def list_all(*, to: Path | None = None) -> int:
    """List the data sets with their sizes and terms, and say which of them have been fetched.

    Args:
      to: Folder of data sets. Without it, $JAXSFM_DATA; if that is not set, the user's data folder.
    """
    from jaxsfm.bench import datasets

    for name, data_set in datasets.DATA_SETS.items():
        here = "fetched" if datasets.is_complete(name, to) else "not fetched"
        published = all(file.known_hash for file in data_set.files)
        hashes = (
            "hash published" if published else "no published hash; that of the download is kept"
        )
        print(f"{name:10s} {here}; {data_set.size}; for jaxsfm bench {data_set.bench}")
        print(f"{'':10s} {data_set.title}")
        print(f"{'':10s} {data_set.page}; terms: {data_set.terms}")
        print(f"{'':10s} {hashes}")
    print(f"folder     {to or datasets.data_folder()}")
    return 0


def fetch(name: Positional[str], *, to: Path | None = None) -> int:
    """Download a data set. If a download is interrupted, the same command continues it.

    For example
        $ jaxsfm data fetch wxbs

    Args:
      name: Name of the data set (jaxsfm data list).
      to: Folder of data sets. Without it, $JAXSFM_DATA; if that is not set, the user's data folder.
    """
    from jaxsfm.bench import datasets

    print(datasets.fetch(name, to, progress=True))
    return 0


def path(name: Positional[str], *, to: Path | None = None) -> int:
    """Print the folder of a data set. The benchmarks take it as --root.

    Args:
      name: Name of the data set (jaxsfm data list).
      to: Folder of data sets. Without it, $JAXSFM_DATA; if that is not set, the user's data folder.
    """
    from jaxsfm.bench import datasets

    print(datasets.path_of(name, to))
    return 0


_Data = one_of({"list": list_all, "fetch": fetch, "path": path})


def data(result: _Data) -> int:  # pyright: ignore[reportInvalidTypeForm]
    """List and download public data sets for the benchmarks."""
    return result
