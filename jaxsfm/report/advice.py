"""What may help a lost photo: options or further photos that the numbers of the run speak for."""

import re
from collections.abc import Collection, Mapping
from typing import NamedTuple

from jaxsfm.config import Config
from jaxsfm.io.images import shown_name
from jaxsfm.io.pairs import Pair, describe
from jaxsfm.report.pair_outcomes import COLMAP_MIN_INLIERS, PairOutcomes
from jaxsfm.report.run_results import Advice

LEAST_ANGLE_DEG = 4.0
"""The least angle at which the rays of a pair's points must meet to give the mapper depth to start
from: the last and lowest of the mapper's demands."""
_SHORTLIST = re.compile(r"\b(retrieval|sequential):(\d+)")
_NO_OPTION = "no option would help; "


class Circumstances(NamedTuple):
    """What a run was made with, as far as advice depends on it."""

    config: Config
    pairs: str
    """The value of `--pairs`."""
    known_camera: bool
    """Whether `--intrinsics` were given."""
    sizes: Mapping[str, tuple[int, int]]
    """(width, height) of every usable photo, pixels."""


def towards_others(
    group: Collection[str], crossing: Collection[Pair], pairs: PairOutcomes, made: Circumstances
) -> list[Advice]:
    """What could connect some photos to the others.

    Args:
      group: photos that trusted pairs join, or that have a model of their own, or a single one.
      crossing: the pairs that were tried between the group and all other photos. If some of them
        are trusted, the mapper did not use them all the same.
    """
    best = pairs.best(crossing)
    found = [
        *_more_pairs(group, crossing, made),
        *_more_handed_on(crossing, pairs),
        *_more_trusted(crossing, pairs),
    ]
    if best is not None and not pairs.verified(best):
        row = pairs.rows[best]
        if row.inliers >= COLMAP_MIN_INLIERS and row.handed_on and not made.known_camera:
            found.append(
                _camera(f"COLMAP verified none of the {row.inliers} matches of {describe(best)}")
            )
        found += _resolution(best, made)
    return [*found, _photos(best, pairs, alone=not found)]


def without_pose(
    name: str, own: Collection[Pair], pairs: PairOutcomes, made: Circumstances, *, model: bool
) -> list[Advice]:
    """What could give a pose to a photo that trusted pairs connect, but the mapper left out.

    Args:
      own: the pairs that were tried with the photo.
      model: whether there is a model. Photos from one spot cannot start a model, but fit into one.
    """
    widest = None if model else pairs.widest_deg(own)
    if widest is not None and widest < LEAST_ANGLE_DEG:
        why = f"the rays of its points meet at {widest:.1f} deg at most"
        return [Advice(option=None, reason=f"{_NO_OPTION}take photos a step to the side: {why}")]
    used = [pair for pair in own if pairs.trusted(pair)]
    best = pairs.best(used)
    assert best is not None, name
    found = [*_more_pairs([name], own, made), *_more_handed_on(own, pairs)]
    if not made.known_camera:
        inliers = pairs.rows[best].colmap_inliers
        found.append(_camera(f"{inliers} inliers in its best pair, but COLMAP found no pose"))
    other = best[best[0] == name]
    near = f"take photos near it, a step to the side of {shown_name(other)}"
    return [*found, Advice(option=None, reason=near if found else _NO_OPTION + near)]


def _camera(why: str) -> Advice:
    return Advice(option="--intrinsics", reason=f"the focal length was guessed; {why}")


def _more_pairs(
    group: Collection[str], tried: Collection[Pair], made: Circumstances
) -> list[Advice]:
    """A longer list of pairs, if some pairs of the group with other photos were not tried."""
    possible = len(group) * (len(made.sizes) - len(group))
    if len(tried) >= possible:
        return []
    why = f"{len(tried)} of its {possible} pairs with others were tried"
    if made.pairs == "exhaustive":  # extend tries only the shortlist of a new photo
        return [
            Advice(
                option="jaxsfm reconstruct", reason=f"run it again into the same folder: only {why}"
            )
        ]
    most = len(made.sizes) - 1
    longer = _SHORTLIST.sub(lambda m: f"{m[1]}:{min(2 * int(m[2]), most)}", made.pairs)
    if longer == made.pairs:  # a file of pairs, or a shortlist that cannot be longer
        longer = "exhaustive"
    return [Advice(option=f"--pairs {longer}", reason=f"only {why}")]


def _more_handed_on(tried: Collection[Pair], pairs: PairOutcomes) -> list[Advice]:
    left = [p for p in tried if pairs.rows[p].inliers and not pairs.rows[p].handed_on]
    best = pairs.best(left)
    if best is None:
        return []
    why = (
        f"choose a larger number, or leave the option out: {len(left)} of its pairs with matches "
        f"were left out, the best, {describe(best)}, with {pairs.rows[best].inliers} matches"
    )
    return [Advice(option="--best-pairs", reason=why)]


def _more_trusted(crossing: Collection[Pair], pairs: PairOutcomes) -> list[Advice]:
    dropped = [p for p in crossing if pairs.verified(p) and not pairs.trusted(p)]
    best = pairs.best(dropped)
    if best is None:
        return []
    why = (
        f"the view graph dropped {len(dropped)} of its pairs, the best, {describe(best)}, with "
        f"{pairs.rows[best].colmap_inliers} inliers; check that both show the same place"
    )
    return [Advice(option="--view-graph no", reason=why)]


def _resolution(best: Pair, made: Circumstances) -> list[Advice]:
    """Larger working images, if the photos are larger or can be enlarged."""
    config = made.config
    found = []
    if config.octaves == 1:
        why = (
            "the preset paper describes photos at one size only; four sizes find more matches at "
            "night and between photos from different distances"
        )
        found.append(Advice(option="--preset default", reason=why))
    sides = {name: max(made.sizes[name]) for name in best}
    large, small = max(best, key=sides.__getitem__), min(best, key=sides.__getitem__)
    if sides[large] > config.max_size:
        size = min(2 * config.max_size, sides[large])
        why = f"{shown_name(large)} was reduced from {sides[large]} to {config.max_size} px"
        found.append(Advice(option=f"--max-size {size}", reason=why))
    if sides[small] < config.max_size and config.enlarge == 1:
        why = f"{shown_name(small)} has only {sides[small]} px; it would be enlarged, up to twice"
        found.append(Advice(option="--preset robust", reason=why))
    return found


def _photos(best: Pair | None, pairs: PairOutcomes, *, alone: bool) -> Advice:
    """Which photos would help; `alone`: no option would."""
    start = _NO_OPTION * alone
    if best is None:
        return Advice(
            option=None, reason=f"{start}take photos that show it together with the others"
        )
    colmap = pairs.rows[best].colmap_inliers
    lack = pairs.missed(best) or f"{colmap} inliers, too few for the mapper"
    return Advice(
        option=None,
        reason=f"{start}take photos between {describe(best)}, the pair that came closest ({lack})",
    )
