"""Photos that are stored sideways without a note in EXIF: which ones, and by how much.

VGG does not recognise turned content, so such photos stay weak. The ones in the model are seen from
their poses. For the others the quarter turns are tried, unless they match a photo of the model well
as they are: a few photos of the model are matched with them at a small size.
"""

import dataclasses
import logging
from collections.abc import Collection, Mapping, Sequence

from jaxsfm.colmap.model_images import registered
from jaxsfm.colmap.poses import model_poses
from jaxsfm.io import orientation
from jaxsfm.io.images import ImageFile, named, orientations
from jaxsfm.io.pairs import Pair, PairCounts, make_pair
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.runs.job import Job
from jaxsfm.runs.matching_looks import job_of_look, match_pairs
from jaxsfm.runs.run_stages import MappedRun
from jaxsfm.sfm.turned_views import quarter_turns

logger = logging.getLogger("jaxsfm")

TRIAL_SIZE = 400
"""Longer side of the photos in a trial, pixels. A trial of a photo then costs about as much as its
description at 800 px."""
PARTNERS = 8
"""Photos of the model that a trial matches."""
LEAST_INLIERS = 60
"""A turn is believed if it has so many verified matches with all partners together, and twice as
many as any other turn. Strangers have a plane of 26 by accident, rarely two."""

MOST = 0.5
"""Photos of a smaller model are turned if the trials turn more than this share of them. It may show
another place, and then some photo of many has `LEAST_INLIERS` by accident: of 53 photos of three
other places beside a model of *cup*, one of Sacre Coeur was turned, and left its model."""
FEW = 0.1
"""If something speaks against the models, they are not made again for so small a share of the
photos. A photo from far above has no clear top, and matches one from the other side when it is
turned: one of the 135 photos of *statue* was, and all rounds of mapping were made again."""


@dataclasses.dataclass(frozen=True)
class Trials:
    """What trials need: photos, and the job that describes and matches them."""

    job: Job
    identity: RunIdentity
    images: Mapping[str, ImageFile]
    seconds: dict[str, float]

    def turn_of(self, name: str, partners: Sequence[str]) -> int:
        """The quarter turns clockwise with which a photo matches; 0 if none is clear."""
        inliers = [self._inliers(name, partners, quarters) for quarters in range(4)]
        best = max(range(4), key=lambda quarters: inliers[quarters])
        others = max(count for quarters, count in enumerate(inliers) if quarters != best)
        return best if inliers[best] >= max(LEAST_INLIERS, 2 * others) else 0

    def _inliers(self, name: str, partners: Sequence[str], quarters: int) -> int:
        """The verified matches of a turned photo with its partners."""
        images = {other: self.images[other] for other in partners}
        images[name] = turned(self.images[name], quarters)
        config = self.job.config
        config = dataclasses.replace(config, max_size=min(TRIAL_SIZE, config.max_size))
        look = job_of_look(self.job, self.identity.with_images([images[name]]), config)
        pairs = [make_pair(name, other) for other in partners]
        counts, _ = match_pairs(look.here(), images, pairs, self.seconds)
        return sum(found.num_inliers for found in counts.values())


def turned(image: ImageFile, quarters: int) -> ImageFile:
    """The photo, turned by further quarter turns clockwise when it is described."""
    code = orientation.turned(image.orientation, quarters)
    return dataclasses.replace(image, orientation=code)


def find_turned(
    mapped: MappedRun, trials: Trials, counts: Mapping[Pair, PairCounts]
) -> dict[str, ImageFile]:
    """The photos that are stored sideways, turned so that they are upright.

    Args:
      mapped: the models after the first look.
      counts: of the pairs that were tried in it.
    """
    images, models = trials.images, mapped.stage.models()
    codes = orientations(images.values())
    turns = quarter_turns(model_poses(models[0]), codes) if models else {}
    placed = set(registered(models[0])) if models else {_best_matched(images, counts)}
    upright = sorted(placed - turns.keys())
    seen_upright = _seen_beside(upright, counts)
    for name in sorted(images.keys() - placed - seen_upright):
        if quarters := trials.turn_of(name, partners(name, upright, counts)):
            turns[name] = quarters
    for model in models[1:]:
        members = set(registered(model)) - placed
        if len(members & turns.keys()) <= MOST * len(members):
            turns = {name: turn for name, turn in turns.items() if name not in members}
    if len(turns) <= FEW * len(images) and not mapped.green():
        return {}
    if turns:
        logger.info("stored sideways, turned and matched again: %s", named([*turns]))
    return {name: turned(images[name], quarters) for name, quarters in sorted(turns.items())}


def _seen_beside(upright: Collection[str], counts: Mapping[Pair, PairCounts]) -> set[str]:
    """The upright photos, and those that match one of them well and so are upright, too.

    In a collection many photos are in no model or a smaller one, and a trial of each takes
    seconds. Of the 135 photos of *statue* the first model has a tenth.
    """
    known = set(upright)
    well = [pair for pair, found in counts.items() if found.num_inliers >= LEAST_INLIERS]
    return {name for pair in well if known & set(pair) for name in pair}


def _best_matched(names: Collection[str], counts: Mapping[Pair, PairCounts]) -> str:
    """The photo with most verified matches; the first by name of several."""
    found = dict.fromkeys(sorted(names), 0)
    for pair, count in counts.items():
        for name in pair:
            found[name] = found.get(name, 0) + count.num_inliers
    return max(found, key=lambda name: found[name])


def partners(name: str, upright: Sequence[str], counts: Mapping[Pair, PairCounts]) -> list[str]:
    """The photos that a photo is tried with: half of them closest to it, half spread over all.

    A photo that is turned has few matches, which say little about what is close to it.
    """

    def closeness(other: str) -> tuple[int, int]:
        found = counts.get(make_pair(name, other))
        return (found.num_inliers, found.num_tentative) if found else (0, 0)

    close = sorted(upright, key=lambda other: (*(-c for c in closeness(other)), other))
    chosen = close[: PARTNERS // 2]
    rest = sorted(close[PARTNERS // 2 :])
    step = max(1, -(-len(rest) // (PARTNERS - len(chosen) or 1)))
    return [*chosen, *rest[::step]]
