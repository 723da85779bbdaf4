"""Closer looks at the photos of a run that are lost, and the refinement that gives them places.

A photo that the mapper has lost is looked at before the models are refined. One that the refinement
takes out, because next to nothing of it agrees, is looked at then.
"""

import dataclasses
import logging
from collections.abc import Collection
from pathlib import Path

from tqdm import tqdm

from jaxsfm.colmap.model_images import registered_in_any
from jaxsfm.io.images import named
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.store import Store
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.closer_looks import look_closer, pairs_to_look_at
from jaxsfm.runs.job import Job
from jaxsfm.runs.mapping_looks import MappedLooks
from jaxsfm.runs.matching_looks import job_of_look, timed
from jaxsfm.runs.run_stages import RunStages
from jaxsfm.sfm.refined_stage import Reconstructed

logger = logging.getLogger("jaxsfm")


def refine_with_closer_looks(
    job: Job, found: MappedLooks, stages: RunStages, target: Path
) -> Reconstructed:
    """Refine the models of a run, with closer looks at its lost photos.

    Args:
      job: that of the run.
      found: the run after all looks at its photos.
      stages: those of the run.
      target: folder for the database.
    """
    mapped = set().union(*found.mapped.photos)
    lost = {image.name for image in found.mapped.given.images} - mapped
    closer = look_at_lost_photos(job, found, lost, mapped, seconds=stages.seconds)
    made = stages.refine(found.mapped, target, closer)
    placed = registered_in_any(made.models)
    closer = look_at_lost_photos(job, found, mapped - placed, placed, seconds=stages.seconds)
    return stages.place(found.mapped, made, closer) if closer else made


def look_at_lost_photos(
    job: Job,
    found: MappedLooks,
    lost: Collection[str],
    placed: Collection[str],
    *,
    seconds: dict[str, float],
) -> dict[Pair, PairResult]:
    """Likely matches of lost photos with photos that have a place.

    Args:
      job: that of the run.
      found: the run after all looks at its photos.
      lost, placed: names of photos.
      seconds: the time is added to that of the stages.

    Returns:
      matches of pairs, original pixels. Pairs that the rounds found to be false are not looked at.
    """
    least, false = job.config.min_inliers, found.mapped.stage.figures.misleading()
    counts = {pair: count for pair, count in found.matched.counts.items() if pair not in false}
    pairs = pairs_to_look_at(lost, placed, counts, least=least)
    if not (job.config.closer_looks and job.config.refinement and pairs):
        return {}
    images = {image.name: image for image in found.mapped.given.images}
    settings = {**job.config.matching(), "closer_looks": job.config.closer_looks}
    identity = dataclasses.replace(found.identity, config=settings)
    store = Store(job.store.path, to_json(identity))
    job = job_of_look(job, found.identity, job.config)
    looked_at = {name for pair in pairs for name in pair} & set(lost)
    logger.info("looking closer at %s", named(sorted(looked_at)))
    bar = tqdm(pairs, desc="closer looks", unit="pair", disable=not job.progress)
    with timed(seconds, "closer looks"):
        return look_closer(job, images, bar, store=store)
