"""The runs of `bench ledger`, each in a process of its own, and RootSIFT's on the same photos.

A run that fails, or whose process dies, becomes a sentence, and the ledger goes on.
"""

import dataclasses
import multiprocessing
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple, TypeVarTuple

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.ledger_photos import SetPhotos
from jaxsfm.bench.methods import method_config
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.given_cameras import parse_cameras
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import build_models
from jaxsfm.colmap.model_folders import write_models
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views
from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.atomic import read_json
from jaxsfm.io.pairs import Pair
from jaxsfm.io.store import FAILED
from jaxsfm.matching.pipeline import open_images
from jaxsfm.report.run_report import FILE, RunReport, read_report
from jaxsfm.runs.job import timed
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions

Given = TypeVarTuple("Given")
ERROR, SECONDS = "error.json", "seconds.json"
"""The file beside a run that says why it ended, and that in RootSIFT's folder that says how long
its stages took. The second one is written last."""


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
    told = read_json(folder.parent / ERROR)
    return str(told["error"]) if isinstance(told, dict) and "error" in told else None


def run_rootsift(run: LedgerRun, folder: Path, pairs: list[Pair] | None) -> None:
    """Reconstruct the photos of a set with COLMAP's own features, verification and mapper.

    Args:
      folder: gets sparse/ and the seconds of the stages.
      pairs: those to match; None: all.
    """
    given, options, seconds = run.given, run.options, dict[str, float]()
    folder.mkdir(parents=True, exist_ok=True)
    database, (images, _) = folder / "database.db", open_images(given.photos)
    known = parse_cameras(given.intrinsics) if given.intrinsics else None
    verification = VerificationOptions(seed=options.seed, threads=options.threads)
    with timed(seconds, "matching"):  # COLMAP does not say how long its extraction takes
        write_rootsift_database(
            database,
            given.photos,
            images,
            Cameras(known=known),
            verification,
            pairs=pairs,
            max_size=run.max_size,
        )
    mapping = MapOptions(
        refine_intrinsics=known is None, seed=options.seed, threads=options.threads
    )
    with timed(seconds, "mapping"):
        models = build_models(database, read_two_views(database), mapping)
    write_models(models, folder / "sparse")
    write_json(folder / SECONDS, seconds)
