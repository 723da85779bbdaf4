"""The matching and the mapping of a run's photos, look by look.

All photos are matched and mapped at a small size first. Then those that turn out to be stored
sideways are turned, the sky is masked if something speaks against the model, and photos that have
found no place are described at full size.
"""

import dataclasses
import functools
import logging
import shutil
from collections.abc import Collection, Mapping
from typing import NamedTuple

from jaxsfm.io.images import ImageFile
from jaxsfm.io.looks import Looks
from jaxsfm.io.pairs import Pair
from jaxsfm.io.work_folder import SKY
from jaxsfm.report.run_inputs import RunIdentity, UsedLooks
from jaxsfm.runs.job import Job, pairs_without
from jaxsfm.runs.matching_looks import (
    MatchedPairs,
    first_look,
    job_of_look,
    match_again,
    match_pairs,
    timed,
)
from jaxsfm.runs.places import places_of_their_own
from jaxsfm.runs.run_stages import MappedRun, RunStages
from jaxsfm.runs.sky_masks import sky_masks, without_sky
from jaxsfm.runs.turned_photos import Trials, find_turned
from jaxsfm.sfm.round import FEWER
from jaxsfm.sfm.second_look import SecondLook

logger = logging.getLogger("jaxsfm")


class MappedLooks(NamedTuple):
    """What the looks at a run's photos gave."""

    matched: MatchedPairs
    mapped: MappedRun
    looks: UsedLooks | None
    """None: all photos were described at the size of the config."""
    identity: RunIdentity
    """That of the run, with the orientations that were found."""
    own_cameras: bool = False
    """Whether each photo has its own camera, because shared ones did not do."""
    masked_sky: int = 0
    """The number of photos whose sky was masked, because something spoke against the model."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunPhotos:
    """The photos of a run that can be decoded, and the pairs of them to match."""

    job: Job
    identity: RunIdentity
    images: Mapping[str, ImageFile]
    pairs: Collection[Pair]

    def match(self, seconds: dict[str, float]) -> tuple[MatchedPairs, dict[str, str]]:
        """Match the pairs at the size of the first look; says also why photos cannot be decoded."""
        first = first_look(self.job.config, self.images.values())
        look = job_of_look(self.job, self.identity, first or self.job.config)
        counts, lost = match_pairs(look, self.images, self.pairs, seconds)
        return MatchedPairs(Looks(look.store), look.config, counts), lost

    @functools.cached_property
    def sky_masks(self) -> dict[str, bytes]:
        """Masks that leave out the sky (`jaxsfm.runs.sky_masks`)."""
        return sky_masks(self.images.values())

    def map(self, matched: MatchedPairs, stages: RunStages) -> MappedRun:
        """Map the photos. If they contradict each other and the sky can be masked, end early.

        Round after round without the pairs that were refuted was of no use on *statue*, where the
        outlines before the sky look alike from four sides.
        """
        if not self.job.config.checked:
            return stages.map(matched)
        return stages.map(matched, lambda: not self.sky_masks)

    def without(self, lost: Collection[str]) -> "RunPhotos":
        """These photos without some."""
        left = {name: image for name, image in self.images.items() if name not in lost}
        return dataclasses.replace(self, images=left, pairs=pairs_without(self.pairs, lost))

    def with_images(self, changed: Mapping[str, ImageFile]) -> "RunPhotos":
        """These photos, some of them turned or with masks."""
        images = {**self.images, **changed}
        identity = self.identity.with_images(changed.values())
        job = job_of_look(self.job, identity, self.job.config)
        return dataclasses.replace(self, images=images, identity=identity, job=job)


def map_in_looks(photos: RunPhotos, matched: MatchedPairs, stages: RunStages) -> MappedLooks:
    """Map the photos; where that leaves photos without a sure place, look again.

    Args:
      matched: the photos after the first look.
    """
    mapped, seconds = photos.map(matched, stages), stages.seconds
    trials = Trials(photos.job, photos.identity, photos.images, seconds)
    checked = photos.job.config.checked  # the paper looks at nothing twice
    if checked and (turned := find_turned(mapped, trials, matched.counts)):
        photos, stages = _changed(photos, turned, stages, "-turned")
        matched, _ = photos.match(seconds)
        mapped = photos.map(matched, stages)
    shared = stages
    if checked and not mapped.settled():
        stages, mapped = _with_own_cameras(matched, mapped, stages)
    own, masked_sky = stages is not shared, 0
    if checked and mapped.doubted():
        masked = _with_masked_sky(photos, mapped, stages)
        if masked is not None:
            photos, matched, stages, mapped = masked
            masked_sky = sum(image.mask is not None for image in stages.images)
        elif mapped.stage.figures.cut_short:
            # Under another name, so that the same command finds both mappings again.
            stages = dataclasses.replace(stages, look=stages.look + "-all-rounds")
            mapped = stages.map(matched)
    found = MappedLooks(matched, mapped, None, photos.identity, own, masked_sky)
    if matched.described == photos.job.config:
        return found
    looks = UsedLooks(first_px=matched.described.max_size)
    again = _to_match_again(photos, found, seconds)
    if again is None:
        return found._replace(looks=looks)
    if not again.pairs:
        return found._replace(looks=dataclasses.replace(looks, photos=again.photos))
    logger.info("%s", again.in_words())
    matched_again = match_again(photos.job, photos.images, matched, again, seconds)
    mapped_again = dataclasses.replace(stages, look=stages.look + "-again").map(matched_again)
    looks = dataclasses.replace(
        looks,
        photos=again.photos,
        again=again.pairs,
        whole=again.whole,
        in_vain=mapped.better_than(mapped_again),
    )
    if looks.in_vain:
        return found._replace(looks=looks)
    return found._replace(matched=matched_again, mapped=mapped_again, looks=looks)


def _to_match_again(
    photos: RunPhotos, found: MappedLooks, seconds: dict[str, float]
) -> SecondLook | None:
    """What to match again at full size; None if all photos are settled.

    Photos of several places make many models, none of which holds most photos. The photos of the
    best model are settled, and those of every model that shows a place of its own. If these are at
    least half of all photos, only the others are matched again.

    With the sky masked, the verdict is amber at best. A second look at all pairs could settle
    nothing, and it takes longer than the first one. So the photos of every model that was checked
    are settled. If something other than neighbours still speaks against a model, no photo is, and
    there are no pairs to match again.
    """
    mapped, counts = found.mapped, found.matched.counts
    if found.masked_sky:
        again = mapped.unsettled(counts, mapped.checked_models())
        if again is None or not (again.whole and mapped.doubted()):
            return again
        logger.info("no second look at all pairs: with the sky masked, the model stays in doubt")
        return SecondLook(again.photos, [], whole=False)
    again = mapped.unsettled(counts)
    if again is None or not again.whole:
        return again
    own = places_of_their_own(photos.job, photos.images, mapped, counts, seconds)
    if not own:
        return again
    return mapped.unsettled(counts, [*own, mapped.checked_models()[0]], places=True)


def _changed(
    photos: RunPhotos, changed: Mapping[str, ImageFile], stages: RunStages, look: str
) -> tuple[RunPhotos, RunStages]:
    """The photos and the stages of another look, in which some photos are turned or have masks."""
    photos = photos.with_images(changed)
    images = [photos.images[image.name] for image in stages.images]
    return photos, dataclasses.replace(stages, images=images, look=stages.look + look)


def _with_masked_sky(
    photos: RunPhotos, mapped: MappedRun, stages: RunStages
) -> tuple[RunPhotos, MatchedPairs, RunStages, MappedRun] | None:
    """The same with the sky masked, if this gives better models; otherwise None."""
    folder = stages.folder.path / SKY
    with timed(stages.seconds, "sky"):
        masks = photos.sky_masks
    if not masks:
        return None
    masked = without_sky(photos.images.values(), masks, folder)
    logger.info("something speaks against the model; matching again without the sky")
    photos, stages = _changed(photos, masked, stages, "-sky")
    matched, _ = photos.match(stages.seconds)
    mapped_masked = stages.map(matched)
    enough = mapped_masked.largest() >= (1 - FEWER) * mapped.largest()
    if not (enough and mapped_masked.better_than(mapped)):
        shutil.rmtree(folder)
        return None
    logger.info("the sky of %d photos is masked, which gave a better model", len(masked))
    return photos, matched, stages, mapped_masked


def _with_own_cameras(
    matched: MatchedPairs, mapped: MappedRun, stages: RunStages
) -> tuple[RunStages, MappedRun]:
    """The stages and the models with a camera for each photo, if these models are better.

    Photos of one drone that all look straight down do not determine the camera that they share, and
    the model bends until photos contradict each other.
    """
    cameras = stages.cameras.each_its_own(stages.images)
    if cameras is None:
        return stages, mapped
    own = dataclasses.replace(stages, cameras=cameras, look=stages.look + "-own-cameras")
    mapped_own = own.map(matched)
    if not mapped_own.better_than(mapped):
        return stages, mapped
    logger.info("shared cameras gave a worse model, so each photo has its own camera")
    return own, mapped_own
