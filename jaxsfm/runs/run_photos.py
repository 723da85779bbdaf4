"""The photos of a run, and how they are matched: the first two steps of the road.

Some photos are stored sideways without a note in EXIF. VGG does not recognise turned content, so a
photo that is turned against the others has no strong pair with them, and photos that strong pairs
join are stored alike. Before the first mapping, the quarter turns of one photo of each group are
tried: it is matched at a small size with a few photos of the largest group.
"""

import dataclasses
import logging
from collections.abc import Collection, Mapping, Sequence, Set

from tqdm import tqdm

from jaxsfm.io import orientation
from jaxsfm.io.images import ImageFile, named
from jaxsfm.io.pairs import Pair, PairCounts, PairResult, components, make_pair
from jaxsfm.io.store import Store
from jaxsfm.report.run_inputs import RunIdentity
from jaxsfm.report.typed_json import to_json
from jaxsfm.runs.further_matching import (
    closest_pairs,
    match_further,
    pairs_to_rematch,
    strongest_first,
)
from jaxsfm.runs.job import (
    Job,
    MatchedPairs,
    job_at_size,
    low_resolution,
    match_pairs,
    pairs_without,
)
from jaxsfm.sfm.limits import REGISTER, TRUST, UPRIGHT
from jaxsfm.sfm.view_graph import relative_weights

logger = logging.getLogger("jaxsfm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunPhotos:
    """The photos of a run that can be decoded, and the pairs of them to match."""

    job: Job
    identity: RunIdentity
    images: Mapping[str, ImageFile]
    pairs: Collection[Pair]

    def match(self, seconds: dict[str, float]) -> tuple[MatchedPairs, dict[str, str]]:
        """Match the pairs at a small size; says also why photos cannot be decoded."""
        first = low_resolution(self.job.config, self.images.values())
        sized = job_at_size(self.job, self.identity, first or self.job.config)
        counts, lost = match_pairs(sized, self.images, self.pairs, seconds)
        return MatchedPairs(sized.store, sized.config, counts), lost

    def match_at_full_size(
        self, before: Mapping[Pair, PairCounts], seconds: dict[str, float]
    ) -> MatchedPairs:
        """Match each photo with its best partners at full size.

        Args:
          before: the counts of the pairs at a small size.
        """
        best = {
            pair
            for name in self.images
            for pair in closest_pairs(name, before)[: REGISTER.partners_without_model]
        }
        job = job_at_size(self.job, self.identity, self.job.config)
        counts, _ = match_pairs(job, self.images, sorted(best), seconds)
        return MatchedPairs(job.store, job.config, counts)

    def upright(
        self, matched: MatchedPairs, seconds: dict[str, float]
    ) -> tuple["RunPhotos", MatchedPairs]:
        """These photos with those turned that are stored sideways, and their matches."""
        trials = Trials(self.job, self.identity, self.images, seconds)
        turned = find_turned(trials, matched.counts)
        if not turned:
            return self, matched
        identity = self.identity.with_images(turned.values())
        job = job_at_size(self.job, identity, self.job.config)
        images = {**self.images, **turned}
        photos = dataclasses.replace(self, job=job, identity=identity, images=images)
        return photos, photos.match(seconds)[0]

    def without(self, lost: Collection[str]) -> "RunPhotos":
        """These photos without some."""
        left = {name: image for name, image in self.images.items() if name not in lost}
        return dataclasses.replace(self, images=left, pairs=pairs_without(self.pairs, lost))


@dataclasses.dataclass(frozen=True)
class LostMatcher:
    """Matches photos without a place with their best partners at full size: as they are, or as seen
    from one place (`jaxsfm.runs.further_matching`)."""

    photos: RunPhotos
    counts: Mapping[Pair, PairCounts]
    """Of all pairs that were tried."""
    tried: set[tuple[Pair, bool]] = dataclasses.field(default_factory=set)
    """The pairs that were looked at, and whether further. No pair is matched twice alike."""

    def __call__(
        self,
        lost: Collection[str],
        registered: Collection[str],
        false: Collection[Pair],
        *,
        further: bool,
    ) -> dict[Pair, PairResult]:
        """Matches of lost photos, original pixels (`jaxsfm.sfm.register.lost.MatchLost`)."""
        counts = {pair: count for pair, count in self.counts.items() if pair not in false}
        least = self.photos.job.config.min_inliers
        pairs = pairs_to_rematch(lost, registered, counts, least=least)
        pairs = [pair for pair in pairs if (pair, further) not in self.tried]
        if not further:
            return self._matched(pairs, lost, further=False)
        for name in self._closest_first({*lost}, pairs):
            if found := self._matched([p for p in pairs if name in p], [name], further=True):
                return found
        return {}

    def _closest_first(self, lost: Set[str], pairs: Sequence[Pair]) -> list[str]:
        """The lost photos of pairs, first the one whose best pair is the strongest."""
        ordered = strongest_first(pairs, self.counts)
        return list(dict.fromkeys(name for pair in ordered for name in pair if name in lost))

    def _matched(
        self, pairs: Sequence[Pair], lost: Collection[str], *, further: bool
    ) -> dict[Pair, PairResult]:
        job, identity = self.photos.job, self.photos.identity
        config = job.config if further else dataclasses.replace(job.config, max_rectified_planes=0)
        if not pairs or (further and not config.max_rectified_planes):
            return {}
        self.tried.update((pair, further) for pair in pairs)
        settings = {**config.matching(), "max_rectified_planes": config.max_rectified_planes}
        store = Store(job.store.path, to_json(dataclasses.replace(identity, config=settings)))
        sought = sorted({name for pair in pairs for name in pair} & {*lost})
        what = "further passes" if further else "full size"
        logger.info("no place yet, %s: %s", what, named(sought))
        bar = tqdm(pairs, desc=what, unit="pair", disable=not job.progress)
        full = job_at_size(job, identity, config)
        return match_further(full, self.photos.images, bar, store=store)


@dataclasses.dataclass(frozen=True)
class Trials:
    """What trials need: photos, and the job that describes and matches them."""

    job: Job
    identity: RunIdentity
    images: Mapping[str, ImageFile]
    seconds: dict[str, float]

    def turn_of(self, name: str, partners: Sequence[str]) -> int:
        """The quarter turns clockwise with which a photo matches; 0 if none is clear."""
        return clear_turn([self._inliers(name, partners, quarters) for quarters in range(4)])

    def _inliers(self, name: str, partners: Sequence[str], quarters: int) -> int:
        """The verified matches of a turned photo with its partners."""
        images = {other: self.images[other] for other in partners}
        images[name] = turned(self.images[name], quarters)
        config = self.job.config
        config = dataclasses.replace(config, max_size=min(UPRIGHT.trial_px, config.max_size))
        sized = job_at_size(self.job, self.identity.with_images([images[name]]), config)
        pairs = [make_pair(name, other) for other in partners]
        counts, _ = match_pairs(sized.here(), images, pairs, self.seconds)
        return sum(found.num_inliers for found in counts.values())


def clear_turn(inliers: Sequence[int]) -> int:
    """The number of quarter turns with clearly the most matches; 0 if there is none.

    Args:
      inliers: the verified matches after 0, 1, 2 and 3 quarter turns.
    """
    best = max(range(4), key=lambda quarters: inliers[quarters])
    others = max(count for quarters, count in enumerate(inliers) if quarters != best)
    needed = max(UPRIGHT.least_inliers, UPRIGHT.times_others * others)
    return best if inliers[best] >= needed else 0


def turned(image: ImageFile, quarters: int) -> ImageFile:
    """The photo, turned by further quarter turns clockwise when it is described."""
    code = orientation.turned(image.orientation, quarters)
    return dataclasses.replace(image, orientation=code)


def find_turned(trials: Trials, counts: Mapping[Pair, PairCounts]) -> dict[str, ImageFile]:
    """The photos that are stored sideways against most others, turned so that they stand as those.

    Args:
      counts: of the pairs that were tried.
    """
    images = trials.images
    upright, *others = groups_stored_alike(images, counts)
    turns = dict[str, int]()
    for group in others:
        name = min(group, key=lambda each: _far(each, upright, counts))
        quarters = trials.turn_of(name, partners(name, sorted(upright), counts))
        turns |= dict.fromkeys(group, quarters) if quarters else {}
    if turns:
        logger.info("stored sideways, turned and matched again: %s", named(sorted(turns)))
    return {name: turned(images[name], quarters) for name, quarters in sorted(turns.items())}


def groups_stored_alike(
    names: Collection[str], counts: Mapping[Pair, PairCounts]
) -> list[set[str]]:
    """Groups of photos that strong pairs join, the largest first; of equal ones, the first by name.

    Photos that are turned against each other have some verified matches, too, but few beside those
    of their best pairs: at most 262 beside 2924 in Herz-Jesus-P8. If no pair is strong, the photo
    with most verified matches comes first.
    """
    inliers = {pair: float(found.num_inliers) for pair, found in counts.items()}
    strength = relative_weights(inliers)
    enough = UPRIGHT.least_inliers
    strong = [p for p, x in strength.items() if x >= TRUST.strong and inliers[p] >= enough]
    groups = components(names, strong)
    if not strong:
        best = _best_matched(names, counts)
        groups.sort(key=lambda group: best not in group)
    return groups


def _far(
    name: str, others: Collection[str], counts: Mapping[Pair, PairCounts]
) -> tuple[int, int, str]:
    """The lower, the more matches a photo has with others; verified ones count first."""
    found = [counts[pair] for pair in (make_pair(name, each) for each in others) if pair in counts]
    verified = sum(each.num_inliers for each in found)
    return -verified, -sum(each.num_tentative for each in found), name


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
    chosen = close[: UPRIGHT.partners // 2]
    rest = sorted(close[UPRIGHT.partners // 2 :])
    step = max(1, -(-len(rest) // (UPRIGHT.partners - len(chosen) or 1)))
    return [*chosen, *rest[::step]]
