"""Which models of a run show places of their own.

Photos of several places in one folder give a model for each place. Its photos need no second look
then. But two models may also be parts of one place that the first look has not connected. So the
strongest pairs between models are matched at full size first.
"""

import itertools
import logging
from collections.abc import Collection, Mapping, Sequence

from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairCounts
from jaxsfm.runs.job import Job
from jaxsfm.runs.matching_looks import match_pairs
from jaxsfm.runs.run_stages import MappedRun
from jaxsfm.sfm.second_look import strongest_first
from jaxsfm.sfm.two_photos.look import evidence_of_photos
from jaxsfm.sfm.two_photos.matched import confidence

logger = logging.getLogger("jaxsfm")

BRIDGES = 3
"""Pairs between two models that are matched at full size."""
ONE_PLACE = 0.5
"""Two models show one place if a pair between them is right with at least this probability. Of 266
pairs of different places, the 25 with most inliers have at most 0.40 (docs/decisions/effort.md)."""


def places_of_their_own(
    job: Job,
    images: Mapping[str, ImageFile],
    mapped: MappedRun,
    counts: Mapping[Pair, PairCounts],
    seconds: dict[str, float],
) -> list[set[str]]:
    """The photos of each model that no sure pair ties to another one.

    Args:
      job: that of the run, at full size. What it matches is kept for a second look.
      images: the photos of the run, by name.
      counts: of all pairs that were tried in the first look.
      seconds: the time is added to that of the stages.

    Returns:
      none if something speaks against a model, if there are fewer than two, or if they share
      photos.
    """
    models = mapped.checked_models()
    if len(models) < 2 or mapped.doubted() or len(set().union(*models)) < sum(map(len, models)):
        return []
    pairs = bridges(models, counts)
    match_pairs(job.here(), images, pairs, seconds)
    sure = [p for p in pairs if confidence(_evidence(job, images, p)) >= ONE_PLACE]
    tied = {name for pair in sure for name in pair}
    own = [model for model in models if not model & tied]
    if own:
        logger.info("%d of %d models show places of their own", len(own), len(models))
    return own


def bridges(models: Sequence[Collection[str]], counts: Mapping[Pair, PairCounts]) -> list[Pair]:
    """The strongest pairs between each two models, sorted.

    Args:
      models: the photos of each model.
      counts: of all pairs that were tried.
    """
    model_of = {name: k for k, model in enumerate(models) for name in model}
    between: dict[frozenset[int], list[Pair]] = {}
    for pair in counts:
        joined = frozenset(model_of[name] for name in pair if name in model_of)
        if len(joined) == 2:
            between.setdefault(joined, []).append(pair)
    strongest = (strongest_first(pairs, counts)[:BRIDGES] for pairs in between.values())
    return sorted(itertools.chain.from_iterable(strongest))


def _evidence(job: Job, images: Mapping[str, ImageFile], pair: Pair) -> float:
    """The evidence of a pair that was matched; 0 if a photo cannot be decoded."""
    found = job.store.load_matches(pair)
    if found is None:
        return 0.0
    return evidence_of_photos(found, (images[pair[0]], images[pair[1]]), config=job.config)
