"""RootSIFT, or ALIKED and LightGlue, on pairs that were chosen before, for a fair comparison."""

from collections.abc import Iterable
from pathlib import Path

from jaxsfm.bench.lightglue import trained_networks, write_lightglue_database
from jaxsfm.bench.methods import LIGHTGLUE, ROOTSIFT
from jaxsfm.bench.options import BenchOptions
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.config import PRESETS
from jaxsfm.errors import UserError
from jaxsfm.io.pairs import Pair
from jaxsfm.matching.pipeline import open_images
from jaxsfm.runs.job import timed

OTHERS = (ROOTSIFT, LIGHTGLUE)
"""The methods that get the pairs of a preset."""


def presets_and_others(options: BenchOptions) -> list[str]:
    """The chosen methods, presets and `OTHERS`; presets come first, because they choose the pairs.

    Raises:
      UserError: a method is unknown, there is no preset, or a package is missing.
    """
    methods = options.chosen_methods([*PRESETS, *OTHERS])
    if methods[0] in OTHERS:
        raise UserError(
            f"--methods: {methods[0]} needs a preset beside it, which chooses the pairs"
        )
    if LIGHTGLUE in methods:
        trained_networks()  # say at once what is missing
    return methods


def write_other_matches(
    database: Path, folder: Path, method: str, pairs: Iterable[Pair], cameras: Cameras
) -> dict[str, float]:
    """Describe the photos of a folder with the features of a method, match and verify the pairs.

    Args:
      database: is written anew; its folder is made.
      method: one of `OTHERS`.

    Returns:
      The seconds of the stages.
    """
    database.parent.mkdir(parents=True, exist_ok=True)
    images, _ = open_images(folder)
    verification, chosen, seconds = VerificationOptions(), sorted(pairs), dict[str, float]()
    if method == ROOTSIFT:
        with timed(seconds, "matching"):
            write_rootsift_database(database, folder, images, cameras, verification, pairs=chosen)
    else:
        write_lightglue_database(
            database, images, cameras, verification, pairs=chosen, seconds=seconds
        )
    return seconds
