"""Which photos and pairs need a second look, at full size, after a first one at a small size.

Most photos find their places in a model from small descriptions, at a quarter of the network's work
and a sixteenth of the products of descriptors. A photo is *settled* if it is in the best model, its
neighbours by name agree with its place, and nothing else speaks against the models. If a model
shows a place of its own (`jaxsfm.runs.places`), or the sky was masked, its photos are settled, too.
The others get a second look:

* If more than a third of the photos are unsettled, or if something speaks against the model, all
  pairs are matched again. The matches of the first look are not used then.
* Otherwise each unsettled photo is matched again with the photos that it came closest to. To get a
  pose, it must see points of the model, and these come from keypoints of the second look, too. So
  trusted pairs between these photos are also matched again. Their matches of the first look stay.
* If models show places of their own, and at least half of the photos are settled, the other half
  may be unsettled. Their pairs are then matched again, and trusted pairs between the photos that
  one of them came closest to.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

from jaxsfm.io.images import named
from jaxsfm.io.pairs import Pair, PairCounts

CLOSEST = 10
"""Pairs of an unsettled photo that are matched again: those with most inliers, then with most
tentative matches."""
MOST_UNSETTLED = 1 / 3
"""If a larger share of the photos is unsettled, all pairs are matched again."""
MOST_OUTSIDE = 1 / 2
"""The same if the settled photos are those of several places."""


class SecondLook(NamedTuple):
    """What is looked at again."""

    photos: list[str]
    """The unsettled photos, sorted."""
    pairs: list[Pair]
    """The pairs to match again, sorted."""
    whole: bool
    """Whether these are all pairs, and the matches of the first look are not used."""

    def in_words(self) -> str:
        """What is looked at again, and why, for the log."""
        which = "all pairs" if self.whole else f"{len(self.pairs)} pairs"
        return f"{which} are matched again at full size, because of {named(self.photos)}"


def second_look(
    counts: Mapping[Pair, PairCounts],
    photos: Collection[str],
    settled: Collection[str],
    trusted: Collection[Pair],
    *,
    places: bool = False,
) -> SecondLook | None:
    """What to look at again; None if all photos are settled.

    Args:
      counts: of all pairs that were tried in the first look.
      photos: the names of all photos.
      settled: those of them that are settled.
      trusted: the verified pairs that the models were made from.
      places: whether the settled photos are those of several places.
    """
    unsettled = sorted(set(photos).difference(settled))
    if not unsettled:
        return None
    share = len(unsettled) / len(photos)
    if share > (MOST_OUTSIDE if places else MOST_UNSETTLED):
        return SecondLook(unsettled, sorted(counts), whole=True)
    own = [closest_pairs(name, counts) for name in unsettled]
    closest = [{name for pair in pairs[:CLOSEST] for name in pair} for pairs in own]
    if share > MOST_UNSETTLED:
        around = closest
    else:
        own = [pairs[:CLOSEST] for pairs in own]
        around = [set().union(*closest)]
    pairs = {pair for pairs in own for pair in pairs}
    pairs |= {pair for pair in trusted if any(near >= set(pair) for near in around)}
    return SecondLook(unsettled, sorted(pairs), whole=False)


def closest_pairs(name: str, counts: Mapping[Pair, PairCounts]) -> list[Pair]:
    """The pairs of a photo: those with most inliers first, then those with most tentative matches.

    Args:
      counts: of pairs that were tried.
    """
    return strongest_first([pair for pair in counts if name in pair], counts)


def strongest_first(pairs: Collection[Pair], counts: Mapping[Pair, PairCounts]) -> list[Pair]:
    """Pairs, those with most inliers first, then those with most tentative matches."""
    return sorted(pairs, key=lambda p: (-counts[p].num_inliers, -counts[p].num_tentative, p))
