"""Which option could help images that were lost, and why: only what the run's numbers bear out."""

import re
from collections.abc import Collection, Mapping
from typing import NamedTuple

from jaxsfm.config import Config
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe
from jaxsfm.report.pair_outcomes import COLMAP_MIN_INLIERS, PairOutcomes

LEAST_ANGLE_DEG = 4.0
"""Rays of a pair that meet at less give the mapper no depth to start from: its last demand."""
_SHORTLIST = re.compile(r"\b(retrieval|sequential):(\d+)")


class Help(NamedTuple):
    """Something that could help."""

    option: str | None
    """As on the command line; None: only other photos would."""
    reason: str


class Circumstances(NamedTuple):
    """What a run was made with, as far as advice depends on it."""

    config: Config
    pairs: str
    """Which pairs are tried: `--pairs`."""
    known_camera: bool
    """Whether `--intrinsics` were given."""
    sizes: Mapping[str, tuple[int, int]]
    """Of every usable image: (width, height), pixels."""


def towards_others(
    group: Collection[str], crossing: Collection[Pair], pairs: PairOutcomes, made: Circumstances
) -> list[Help]:
    """What could connect a group of images to the others.

    Args:
      group: images that trusted pairs join or that have a model of their own, or a single one.
      crossing: the pairs tried between them and all others. Trusted ones did not lead the mapper
        over.
    """
    best = pairs.best(crossing)
    found = [
        *_more_pairs(group, crossing, made),
        *_more_handed_on(crossing, pairs),
        *_more_trusted(crossing, pairs),
    ]
    if best is not None and best not in pairs.verified:
        tried = pairs.results[best].num_inliers
        if tried >= COLMAP_MIN_INLIERS and best in pairs.handed_on and not made.known_camera:
            found.append(
                _camera(f"COLMAP verified none of the {tried} matches of {describe(best)}")
            )
        found += _resolution(best, made)
    return [*found, _photos(best, pairs, alone=not found)]


def without_pose(
    name: str, own: Collection[Pair], pairs: PairOutcomes, made: Circumstances, *, model: bool
) -> list[Help]:
    """What could give an image a pose that trusted pairs connect, but the mapper left out.

    Args:
      own: the pairs tried with it.
      model: whether the others have a model, into which even photos from one spot fit.
    """
    widest = None if model else pairs.widest_deg(own)
    if widest is not None and widest < LEAST_ANGLE_DEG:
        why = f"the rays of its points meet at {widest:.1f} deg at most"
        return [Help(None, f"no option would help, only photos from a step aside: {why}")]
    used = [pair for pair in own if pairs.trusted(pair)]
    best = pairs.best(used)
    assert best is not None, name
    found = [*_more_pairs([name], own, made), *_more_handed_on(own, pairs)]
    if not made.known_camera:
        inliers = pairs.verified[best]
        found.append(_camera(f"{inliers} inliers in its best pair, but COLMAP found no pose"))
    other = best[best[0] == name]
    near = f"photos near it, taken a step aside of {shown_name(other)}"
    return [*found, Help(None, near if found else f"no option would help, only {near}")]


def _camera(why: str) -> Help:
    return Help("--intrinsics", f"the focal length was guessed; {why}")


def _more_pairs(group: Collection[str], tried: Collection[Pair], made: Circumstances) -> list[Help]:
    """A longer list of pairs, where pairs of the group with others have not been tried."""
    possible = len(group) * (len(made.sizes) - len(group))
    if len(tried) >= possible:
        return []
    why = f"{len(tried)} of its {possible} pairs with others were tried"
    if made.pairs == "exhaustive":  # extend tries a new photo's shortlist alone
        return [Help("jaxsfm reconstruct", f"again into the same folder: {why}")]
    most = len(made.sizes) - 1
    longer = _SHORTLIST.sub(lambda m: f"{m[1]}:{min(2 * int(m[2]), most)}", made.pairs)
    if longer == made.pairs:  # a file of pairs, or the shortlist is as long as it can be
        longer = "exhaustive"
    return [Help(f"--pairs {longer}", why)]


def _more_handed_on(tried: Collection[Pair], pairs: PairOutcomes) -> list[Help]:
    left = [p for p in tried if pairs.results[p].num_inliers and p not in pairs.handed_on]
    best = pairs.best(left)
    if best is None:
        return []
    why = (
        f"a larger number, or without it: {len(left)} of its pairs with matches were left out, the "
        f"best, {describe(best)}, with {pairs.results[best].num_inliers}"
    )
    return [Help("--best-pairs", why)]


def _more_trusted(crossing: Collection[Pair], pairs: PairOutcomes) -> list[Help]:
    dropped = [p for p in crossing if p in pairs.verified and not pairs.trusted(p)]
    best = pairs.best(dropped)
    if best is None:
        return []
    why = (
        f"the view graph dropped {len(dropped)} of its pairs, the best, {describe(best)}, with "
        f"{pairs.verified[best]} inliers; look whether both show the same place"
    )
    return [Help("--view-graph no", why)]


def _resolution(best: Pair, made: Circumstances) -> list[Help]:
    """Larger working images, where the photos have more, or can be enlarged."""
    config = made.config
    found = []
    if config.octaves == 1:
        why = "the preset paper describes photos at one size only; by night or at other distances"
        found.append(Help("--preset default", f"{why} four of them find more"))
    sides = {name: max(made.sizes[name]) for name in best}
    large, small = max(best, key=sides.__getitem__), min(best, key=sides.__getitem__)
    if sides[large] > config.max_size:
        size = min(2 * config.max_size, sides[large])
        why = f"{shown_name(large)} was reduced from {sides[large]} to {config.max_size} px"
        found.append(Help(f"--max-size {size}", why))
    if sides[small] < config.max_size and config.enlarge == 1:
        why = f"{shown_name(small)} has only {sides[small]} px; it would be enlarged, up to twice"
        found.append(Help("--preset robust", why))
    return found


def _photos(best: Pair | None, pairs: PairOutcomes, *, alone: bool) -> Help:
    only = "no option would help, only " * alone
    if best is None:
        return Help(None, f"{only}photos that show it together with the others")
    lack = pairs.missed(best) or f"{pairs.verified[best]} inliers, too little for the mapper"
    return Help(None, f"{only}photos between {describe(best)}, which come nearest ({lack})")
