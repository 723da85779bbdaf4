"""Parts of the sets of `bench ledger`, mapped and checked: how often is the check wrong?

A part is photos that stand near each other in the order of their names, with gaps. Each part is
mapped once, and nothing mends, splits or refines the model before it is judged. A few sets give
many models in this way, most of them right. They are not independent of each other: parts of one
set share photos and matches.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxsfm.bench.frames import linked
from jaxsfm.bench.ledger_photos import SetPhotos
from jaxsfm.bench.ledger_runs import LedgerRun, reconstruct_set
from jaxsfm.bench.strecha_models import take_matches
from jaxsfm.bench.subset_models import forget_results
from jaxsfm.io.photo_folder import find_images
from jaxsfm.options import Step
from jaxsfm.sfm.evaluation import of_photos

NOTHING_AFTER: tuple[Step, ...] = (
    "upright",
    "map-again",
    "split",
    "second-places",
    "refine",
    "register",
)
"""What a run leaves out so that its first mapping is judged as it is."""
LEAST, MOST = 5, 16
"""Sizes of parts, photos. Smaller ones say little, and larger ones are much alike."""
WITHIN = 2
"""A part is drawn from so many times as many photos that follow each other."""


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
