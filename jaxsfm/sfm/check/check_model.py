"""The check of one model after mapping: do its photos agree with it, and with no other model?

The second question takes longer than the first one, and is asked of models that are kept.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

from jaxsfm.colmap.model import Model
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.check.agreement import Agreement, agreement
from jaxsfm.sfm.check.doubt import CURVE, MAX_CONTRADICTED
from jaxsfm.sfm.check.grouping import Grouping, disagreement, group_views, parts, share
from jaxsfm.sfm.check.model_check import MIN_VIEWS, Contradiction, ModelCheck, OtherPlace
from jaxsfm.sfm.check.other_places import Refused, Surface, other_places
from jaxsfm.sfm.check.pair_fit import pair_fits
from jaxsfm.sfm.check.scale import shrunk
from jaxsfm.sfm.check.thinning import thinned
from jaxsfm.sfm.limits import CHECK
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.device_images import DeviceImages

MIN_POINTS = 30
"""A model with fewer points is not checked."""
CHECKED_BY = (
    "radius",
    "iterations",
    "min_score",
    "max_sigma_px",
    "max_shift_px",
    "min_cosine",
    "max_stretch",
    "neighbours",
)
"""Fields of `Refinement` that a check depends on."""


class VerifiedMatches(NamedTuple):
    """The matches that a model may rest on."""

    matches: Mapping[Pair, PairResult]
    """By pair, original pixels."""
    pairs: Collection[Pair]
    """Those that COLMAP verified."""
    seed: int
    """For RANSAC."""


class Checked(NamedTuple):
    """The outcome of a check."""

    check: ModelCheck
    refuted: dict[Pair, Contradiction]
    """Pairs that agree with the model and whose two photos contradict each other there."""
    suspected: dict[Pair, Contradiction]
    """Pairs that agree with the model and join groups that contradict each other. Some of them may
    be right: then the groups were joined wrongly elsewhere."""
    explained: set[Pair]
    """Pairs that agree with the model and join no groups that contradict each other."""
    against: set[Pair]
    """Pairs that do not agree with the model."""
    parts: list[list[str]]
    """The photos in parts in which no groups contradict each other and something holds the groups
    together, the largest first. Right models of ordinary photos are one part."""


def check_model(
    model: Model, images: DeviceImages, given: VerifiedMatches, refinement: Refinement
) -> Checked | None:
    """Check a model.

    If groups of its photos contradict each other, the pairs that joined them are refuted. Second
    places are not looked for (`second_places`).

    Args:
      images: those of the views, in the model's pixels.
      refinement: how patches are aligned, and when they agree.

    Returns:
      None if the model is too small.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    if len(model.views) < MIN_VIEWS or len(model.tracks.points) < MIN_POINTS:
        return None
    seen, near = model.tracks, shrunk(model)
    model = thinned(model)
    names = [view.name for view in model.views]
    found = agreement(model, images, refinement)
    grouping = group_views(found)
    contradictions = _named(grouping, names)
    normal = plane_geometry.normals(model, neighbours=refinement.neighbours)
    fits = pair_fits(model, normal, given.matches, given.pairs)
    refuted, suspected = {}, {}
    for least in (CHECK.fit, *CHECK.lower_fits) if contradictions else ():
        fitting = [p for p, fit in fits.items() if fit >= least]
        refuted = _refuted(found, names, fitting)
        suspected = {
            pair: each
            for pair in fitting
            for each in contradictions
            if each.joined_by(pair) and pair not in refuted
        }
        if refuted or suspected:
            break
    groups = [sorted(names[k] for k in group) for group in grouping.groups]
    check = ModelCheck(
        groups=groups,
        contradictions=contradictions,
        other_places=[],
        shrunk=near,
        doubt=CURVE.probability(disagreement(found)),
    )
    agreeing = {pair for pair, fit in fits.items() if fit >= CHECK.fit}
    explained = {p for p in agreeing if not any(each.joined_by(p) for each in contradictions)}
    whole = parts(grouping, seen.view, seen.point)
    apart = [sorted(names[k] for k in part) for part in whole]
    return Checked(check, refuted, suspected, explained, fits.keys() - agreeing, apart)


def second_places(
    model: Model,
    images: DeviceImages,
    given: VerifiedMatches,
    refinement: Refinement,
    against: Collection[Pair],
) -> list[OtherPlace]:
    """The second places of the photos of a model that has been checked.

    Args:
      images, given, refinement: as in `check_model`.
      against: the pairs that do not agree with the model.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    model = thinned(model)
    normal = plane_geometry.normals(model, neighbours=refinement.neighbours)
    refused = Refused({pair: given.matches[pair] for pair in sorted(against)}, given.seed)
    return other_places(Surface(model, normal), images, refinement, refused)


def _refuted(found: Agreement, names: list[str], fitting: list[Pair]) -> dict[Pair, Contradiction]:
    """The pairs whose two photos contradict each other."""
    index = {name: k for k, name in enumerate(names)}
    against = found.beyond_light()
    shares = share(found.tested, against)
    refuted = {}
    for pair in fitting:
        a, b = (index[name] for name in pair)
        counts = [(against[i, j], found.tested[i, j]) for i, j in ((a, b), (b, a))]
        least, tested = min(counts)
        if shares[a, b] > MAX_CONTRADICTED and least >= CHECK.least_contradicted:
            refuted[pair] = Contradiction(
                images=[pair[0]], others=[pair[1]], tested=int(tested), contradicted=int(least)
            )
    return refuted


def _named(grouping: Grouping, names: list[str]) -> list[Contradiction]:
    """The contradictions with the names of the photos."""
    return [
        Contradiction(
            images=sorted(names[k] for k in each.groups[0]),
            others=sorted(names[k] for k in each.groups[1]),
            tested=each.tested,
            contradicted=each.contradicted,
        )
        for each in grouping.contradictions
    ]
