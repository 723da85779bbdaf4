"""How long a run will take, from the first photos and pairs of this very run.

The first photos are described, and the first pairs among them matched, before all others. Nothing
is done twice: their results are kept like all others. The rest of the run, from COLMAP's
verification to the check, is a multiple of the time of extraction and matching on a CPU.

An accelerator speeds up extraction and matching a hundred times, and the mapping not at all, so
nothing is said there.
"""

import dataclasses
import logging
import statistics
import time
from collections.abc import Sequence
from typing import NamedTuple

from tqdm import tqdm

from jaxsfm.io.images import ImageFile
from jaxsfm.io.pair_selection import natural, sequential_pairs
from jaxsfm.io.pairs import Pair
from jaxsfm.matching.execution import select_devices
from jaxsfm.runs.job import Job, job_at_size, low_resolution, pairs_without, timed
from jaxsfm.runs.run_photos import RunPhotos

logger = logging.getLogger("jaxsfm")

PHOTOS, PAIRS = 6, 10
"""So many photos and pairs are measured: a tenth of a usual run of 19 photos and 171 pairs."""
WARM = 2
"""The first photos and pairs are not counted, because programs are compiled for them."""
LOW_REST, HIGH_REST = 0.5, 1.6
"""The time of what follows matching, as a multiple of extraction and matching together: the range
of 20 runs of 11 sets with 8 to 500 photos on two cores, whose median is 0.9
(docs/performance.md)."""
JOINED = 0.6
"""The pairs that retrieval finds, as a share of photos times partners: many photos choose each
other. It is 0.57 to 0.65 for 50 and 500 frames of kitchen and for the 135 photos of statue."""


class Speed(NamedTuple):
    """What one photo and one pair take, seconds."""

    photo_s: float
    pair_s: float


def expected_s(speed: Speed, photos: int, pairs: int) -> tuple[float, float]:
    """The least and the most that a whole run of so many photos and pairs may take, seconds.

    It is for a run whose programs have been compiled.
    """
    found = photos * speed.photo_s + pairs * speed.pair_s
    return (1 + LOW_REST) * found, (1 + HIGH_REST) * found


def in_words(least_s: float, most_s: float) -> str:
    """A time between two bounds, in the unit that suits it."""
    units = (("hours", 3600.0, 1), ("minutes", 60.0, 1), ("seconds", 1.0, 10))
    unit, size, step = next(each for each in units if most_s >= 3 * each[1] or each[1] == 1)
    least, most = (max(step, round(each / size / step) * step) for each in (least_s, most_s))
    return f"{most} {unit}" if least == most else f"{least} to {most} {unit}"


def expected_pairs(known: int, photos: int, retrieval: int) -> int:
    """How many pairs a run will match.

    Args:
      known: the pairs that are chosen already.
      retrieval: with how many similar photos each photo will be paired besides.
    """
    possible = photos * (photos - 1) // 2
    return min(possible, known + round(JOINED * photos * retrieval))


def first_pairs(pairs: Sequence[Pair]) -> list[Pair]:
    """The first pairs among few photos: at most `PAIRS` pairs of at most `PHOTOS` photos."""
    chosen: list[Pair] = []
    names: set[str] = set()
    for pair in sorted(pairs, key=lambda each: sorted(map(natural, each), reverse=True)):
        if len(chosen) < PAIRS and len(names.union(pair)) <= PHOTOS:
            chosen.append(pair)
            names.update(pair)
    return chosen


def tell_time(photos: RunPhotos, retrieval: int, seconds: dict[str, float]) -> None:
    """Say how long the run will take, if this is known: before a run of more than a few photos
    that has just begun on a CPU.

    Args:
      photos: with the pairs that are known before photos are compared for retrieval.
      retrieval: as in `expected_pairs`.
      seconds: the time of each stage, to which the time of the first ones is added.
    """
    images, job = photos.images, photos.job
    if job.engine.starts_workers:  # the devices are theirs
        return
    mesh = select_devices(job.execution)
    if mesh.devices.flat[0].platform != "cpu":
        return
    config = low_resolution(job.config, images.values()) or job.config
    sized = job_at_size(job, photos.identity, config)
    pairs = first_pairs([*(photos.pairs or sequential_pairs(images, PAIRS))])
    begun = any(map(sized.store.has_features, images.values())) or any(
        sized.store.load_matches(pair) is not None for pair in pairs
    )
    if len(images) <= PHOTOS or begun:
        return
    speed = _measured(sized, [*images.values()], pairs, seconds)
    if speed is None:
        return
    count = expected_pairs(len(photos.pairs), len(images), retrieval)
    logger.info(
        "%d photos and %s%d pairs will take %s in all, by the speed of the first ones",
        *(len(images), "about " * bool(retrieval), count),
        in_words(*expected_s(speed, len(images), count)),
    )


def _measured(
    job: Job, images: Sequence[ImageFile], pairs: Sequence[Pair], seconds: dict[str, float]
) -> Speed | None:
    """Describe and match the first ones; None if too few of them could be."""
    by_name = {image.name: image for image in images}
    names = sorted({name for pair in pairs for name in pair}, key=natural)
    quiet = dataclasses.replace(job, progress=False)
    lost: dict[str, str] = {}
    total = len(names) + len(pairs)
    with tqdm(total=total, desc="first ones", unit="step", disable=not job.progress) as bar:
        with timed(seconds, "extraction"):
            clock = [time.monotonic()]
            for name in names:
                lost |= quiet.extract_missing([by_name[name]])
                clock.append(time.monotonic())
                bar.update()
        photo_s = _median_step(clock)
        with timed(seconds, "matching"):
            clock = [time.monotonic()]
            for _ in quiet.match_missing(by_name, pairs_without(pairs, lost)):
                clock.append(time.monotonic())
                bar.update()
        pair_s = _median_step(clock)
    if photo_s is None or pair_s is None:
        return None
    return Speed(photo_s, pair_s)


def _median_step(clock: Sequence[float]) -> float | None:
    """The median time between readings of a clock, without the first `WARM`; None if too few."""
    steps = [after - before for before, after in zip(clock, clock[1:], strict=False)][WARM:]
    return statistics.median(steps) if steps else None
