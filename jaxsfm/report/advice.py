"""What may help a lost photo: the options that the numbers of the run speak for.

There is at most one sentence for each cause. Where no option would help, photos would.
"""

import re
from collections.abc import Collection, Iterable

from jaxsfm.colmap.mapper import LOW_ANGLE_DEG
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import describe
from jaxsfm.report.pair_outcomes import COLMAP_MIN_INLIERS, PairOutcomes, furthest
from jaxsfm.report.run_results import Advice, PairRow

_SHORTLIST = re.compile(r"\b(retrieval|sequential):(\d+)")


def towards_others(
    group: Collection[str], crossing: Collection[PairRow], pairs: PairOutcomes
) -> list[Advice]:
    """What could connect some photos to the others.

    Args:
      group: photos that trusted pairs join, or that have a model of their own, or a single one.
      crossing: the pairs that were tried between the group and all other photos. If some of them
        are trusted, the mapper did not use them all the same.
    """
    best = furthest(crossing)
    found = [
        *_more_pairs(group, crossing, pairs),
        *_more_handed_on(crossing),
        *_more_trusted(crossing),
    ]
    if best is not None and not best.verified:
        if best.inliers >= COLMAP_MIN_INLIERS and best.handed_on and not pairs.known_camera:
            found.append(_camera())
        found += _resolution(best, pairs)
    if found:
        return found
    if best is None:
        return [_photos("photos that show it together with the others")]
    lack = pairs.missed(best) or f"{best.colmap_inliers} inliers, which did not join them"
    return [_photos(f"photos between {describe(best.pair)}, the pair that came closest ({lack})")]


def without_pose(
    name: str, own: Collection[PairRow], pairs: PairOutcomes, *, model: bool
) -> list[Advice]:
    """What could give a pose to a photo that trusted pairs connect, but the mapper left out.

    Args:
      own: the pairs that were tried with the photo.
      model: whether there is a model. Photos from one spot cannot start a model, but fit into one.
    """
    widest = None if model else pairs.widest_deg(own)
    if widest is not None and widest < LOW_ANGLE_DEG:
        why = f"the rays of its points meet at {widest:.1f} deg at most"
        return [_photos(f"photos a step to the side: {why}")]
    found = [*_more_pairs([name], own, pairs), *_more_handed_on(own)]
    if not pairs.known_camera:
        found.append(_camera())
    if found:
        return found
    best = furthest(row for row in own if row.trusted)
    assert best is not None, name
    (other,) = set(best.pair) - {name}
    return [_photos(f"photos near it, a step to the side of {shown_name(other)}")]


def _photos(which: str) -> Advice:
    return Advice(option=None, reason=f"no option would help; take {which}")


def _camera() -> Advice:
    return Advice(option="--intrinsics", reason="the focal length was guessed")


def _more_pairs(
    group: Collection[str], tried: Collection[PairRow], pairs: PairOutcomes
) -> Iterable[Advice]:
    """A longer list of pairs, if some pairs of the group with other photos were not tried."""
    photos = len(pairs.sizes)
    possible = len(group) * (photos - len(group))
    if len(tried) >= possible:
        return
    why = f"only {len(tried)} of its {possible} pairs with others were tried"
    if pairs.selection == "exhaustive":  # extend tries only the shortlist of a new photo
        why = f"run it again into the same folder: {why}"
        yield Advice(option="jaxsfm reconstruct", reason=why)
        return
    longer = _SHORTLIST.sub(lambda m: f"{m[1]}:{min(2 * int(m[2]), photos - 1)}", pairs.selection)
    if longer == pairs.selection:  # a file of pairs, or a shortlist that cannot be longer
        longer = "exhaustive"
    yield Advice(option=f"--pairs {longer}", reason=why)


def _more_handed_on(tried: Collection[PairRow]) -> Iterable[Advice]:
    left = [row for row in tried if row.inliers and not row.handed_on]
    best = furthest(left)
    if best is not None:
        why = (
            f"a larger number would take in {len(left)} more of its pairs, the best, "
            f"{describe(best.pair)}, with {best.inliers} matches"
        )
        yield Advice(option="--best-pairs", reason=why)


def _more_trusted(crossing: Collection[PairRow]) -> Iterable[Advice]:
    dropped = [row for row in crossing if row.outvoted]
    best = furthest(dropped)
    if best is not None:
        why = (
            f"the view graph dropped {len(dropped)} of its pairs; check that both photos of the "
            f"best, {describe(best.pair)}, show the same place"
        )
        yield Advice(option="--view-graph no", reason=why)


def _resolution(best: PairRow, pairs: PairOutcomes) -> Iterable[Advice]:
    """One way to more detail, if there is one."""
    config = pairs.config
    sides = {name: max(pairs.sizes[name]) for name in best.pair}
    large, small = max(best.pair, key=sides.__getitem__), min(best.pair, key=sides.__getitem__)
    if config.octaves == 1:
        yield Advice(option="--preset default", reason="paper describes photos at one size only")
    elif sides[large] > config.max_size:
        size = min(2 * config.max_size, sides[large])
        why = f"{shown_name(large)} was reduced from {sides[large]} to {config.max_size} px"
        yield Advice(option=f"--max-size {size}", reason=why)
    elif sides[small] < config.max_size and config.enlarge == 1:
        why = f"{shown_name(small)} has only {sides[small]} px"
        yield Advice(option="--preset robust", reason=why)
