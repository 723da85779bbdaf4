"""The runs of `bench ledger`: whole sets, RootSIFT's on the same photos, and parts of sets.

A run of a whole set has a process of its own. If it fails, or its process dies, it becomes a
sentence, and the ledger goes on.

A part is photos that stand near each other in the order of their names, with gaps. Each part is
mapped once, and nothing mends, splits or refines the model before it is judged: how often is the
check wrong? A few sets give many models in this way, most of them right. They are not independent
of each other: parts of one set share photos and matches.
"""

import dataclasses
import multiprocessing
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple, TypeVarTuple

import numpy as np

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.inputs import linked
from jaxsfm.bench.ledger_sets import SetPhotos
from jaxsfm.bench.methods import method_config
from jaxsfm.bench.strecha_models import map_rootsift, take_matches
from jaxsfm.bench.subset_models import forget_results
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.given_cameras import parse_cameras
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.entries import FAILED
from jaxsfm.io.pairs import Pair
from jaxsfm.io.photo_folder import find_images
from jaxsfm.io.typed_files import read_json
from jaxsfm.options import Step
from jaxsfm.report.run_report import FILE, RunReport, read_report
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.evaluation import of_photos

Given = TypeVarTuple("Given")
ERROR, SECONDS = "error.json", "seconds.json"
"""The file beside a run that says why it ended, and that in RootSIFT's folder that says how long
its stages took. The second one is written last."""
NOTHING_AFTER: tuple[Step, ...] = (
    "upright",
    "remap",
    "split",
    "pose-ambiguity",
    "refine",
    "register",
)
"""What a run leaves out so that its first mapping is judged as it is."""
LEAST, MOST = 5, 16
"""Sizes of parts, photos. Smaller ones say little, and larger ones are much alike."""
WITHIN = 2
"""A part is drawn from so many times as many photos that follow each other."""


class LedgerRun(NamedTuple):
    """How the photos of a set are reconstructed."""

    given: SetPhotos
    options: RunOptions
    """The seed, the threads and what is not of the set."""
    max_size: int | None = None

    @property
    def all_options(self) -> RunOptions:
        """The options with those of the set."""
        given = self.given
        return dataclasses.replace(self.options, intrinsics=given.intrinsics, pairs=given.pairs)


def apart(work: Callable[[*Given], object], *args: *Given) -> str:
    """Do some work in a process of its own; returns why it failed, or an empty text.

    Args:
      work: a function of a module, so that the process can import it.
    """
    context = multiprocessing.get_context("spawn")
    answers, ours = context.Pipe(duplex=False)
    process = context.Process(target=_answering, args=(ours, work, args))
    process.start()
    ours.close()
    try:
        try:
            answer = answers.recv()
        except EOFError:
            process.join()
            answer = f"the process ended with exit status {process.exitcode}"
        process.join()
    finally:  # also after Ctrl-C
        process.terminate()
        process.join()
    return answer


def _answering(answers: Connection, work: Callable[..., object], args: tuple[object, ...]) -> None:
    """Do the work, and send why it failed."""
    try:
        with interrupt.noted():
            work(*args)
        answers.send("")
    except UserError as error:
        answers.send(str(error))
    except Exception as error:
        traceback.print_exc()
        answers.send(f"{type(error).__name__}: {error}".splitlines()[0])


def reconstruct_set(run: LedgerRun, folder: Path) -> None:
    """Reconstruct the photos of a set with the preset `default`."""
    config = method_config("default", max_size=run.max_size)
    reconstruct_folder(run.given.photos, folder, config=config, options=run.all_options)


def finished_run(folder: Path) -> Path | None:
    """Where the results of a run are: in its folder or in `failed` there; None: nowhere."""
    return next((at for at in (folder, folder / FAILED) if (at / FILE).is_file()), None)


def run_set(run: LedgerRun, folder: Path) -> RunReport | str:
    """The report of a run; the run is made unless `folder` has its results.

    Returns:
      why there is no report, if there is none. It is kept beside the folder.
    """
    error = folder.parent / ERROR
    if finished_run(folder) is None:
        if why := apart(reconstruct_set, run, folder):
            folder.parent.mkdir(parents=True, exist_ok=True)
            write_json(error, {"error": why})
            return why
    error.unlink(missing_ok=True)
    return kept_run(folder) or "the run left no report"


def kept_run(folder: Path) -> RunReport | str | None:
    """The report of a run that was made, or why it ended; None if neither is there."""
    if (at := finished_run(folder)) is not None:
        try:
            return read_report(at)
        except UserError as error:
            return str(error)
    return (read_json(folder.parent / ERROR, dict[str, str]) or {}).get("error")


def run_rootsift(run: LedgerRun, folder: Path, pairs: list[Pair] | None) -> None:
    """Reconstruct the photos of a set with COLMAP's own features, verification and mapper.

    Args:
      folder: gets sparse/ and the seconds of the stages.
      pairs: those to match; None: all.
    """
    known = parse_cameras(run.given.intrinsics) if run.given.intrinsics else None
    mapping = MapOptions(
        refine_intrinsics=known is None, seed=run.options.seed, threads=run.options.threads
    )
    folder.mkdir(parents=True, exist_ok=True)
    made = map_rootsift(
        run.given.photos, folder, Cameras(known=known), mapping, pairs=pairs, max_size=run.max_size
    )
    write_json(folder / SECONDS, made.seconds)


def part_of(names: Sequence[str], number: int) -> list[str]:
    """The photos of a part, sorted; it depends on the names and the number alone.

    Args:
      names: of all photos, in order; more than `LEAST`.
    """
    random = np.random.default_rng(number)
    size = int(random.integers(LEAST, min(MOST, len(names) - 1) + 1))
    reach = min(WITHIN * size, len(names))
    start = int(random.integers(0, len(names) - reach + 1))
    inside = random.choice(reach, size, replace=False)
    return sorted(names[start + int(k)] for k in inside)


def part_runs(
    run: LedgerRun, home: Path, whole: Path, count: int
) -> Iterator[tuple[int, SetPhotos, Path]]:
    """Map parts of a set; yields the number of each, its photos, and the folder of its run.

    The folder is used again for the next part. Matches of the whole set are used where they fit.

    Args:
      run: of the whole set; its options are those of the parts.
      home: a folder for the runs.
      whole: the folder of a run of the whole set, if there is one.
      count: the number of parts. 0, or a set that is too small: the only part is the whole set.
    """
    given, folder = run.given, home / "run"
    truth, names = given.truth, sorted(find_images(given.photos))
    if truth is not None:
        names = [name for name in names if of_photos(truth, [name])]
    take_matches(folder, whole)
    divided = count > 0 and len(names) > LEAST
    for number in range(count if divided else 1):
        if folder.is_dir():
            forget_results(folder)
        part = part_of(names, number) if divided else names
        photos = linked(given.photos, part, home / "photos")
        each = given._replace(photos=photos, truth=truth and of_photos(truth, part))
        reconstruct_set(run._replace(given=each), folder)
        yield number, each, folder
