"""Why a photo was lost, or why there is no model.

A photo is lost if it has no pose in the best model. For each lost photo the report names the stage
that lost it, the numbers that decided, and what may help:

* `jaxsfm.report.pair_outcomes` says how far each pair of photos came, what it lacked, and which
  photos trusted pairs join;
* this module says at which stage a photo was lost;
* `jaxsfm.report.advice` says which option, or which further photos, could help.
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from jaxsfm.colmap.mapper import LOW_ANGLE_DEG
from jaxsfm.config import Config
from jaxsfm.io.pairs import Pair, describe
from jaxsfm.report.advice import towards_others, without_pose
from jaxsfm.report.pair_outcomes import (
    PairOutcomes,
    PhotoGroup,
    furthest,
    photo_groups,
    view_graph_report,
)
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.run_results import Advice, LostPhoto, PairRow, PairStatus, Stage

_ONE_PLACE = "the photos were taken from one place, turned about, so nothing gives depth"
_MOVE = "move sideways between photos"
_MASK = "mask what stays at the same pixels in all photos: it gives no depth"


class _Refused(NamedTuple):
    """Why a photo has no place although places were looked for after the mapping."""

    had_pose: bool
    """Whether there was a pose, which something speaks against."""
    why: str


def explained(
    report: RunReport,
    config: Config,
    sizes: Mapping[str, tuple[int, int]],
    angles: Mapping[Pair, float],
) -> RunReport:
    """The report with what follows from its pairs and models: the groups of photos, why photos were
    lost and what may help them, and why there is no model.

    Args:
      sizes: (width, height) of every usable photo that is still there, pixels. Pairs with other
        photos are left out.
      angles: the angle at which the rays of a verified pair's points meet (median), degrees; 0
        where it is unknown.
    """
    pairs = PairOutcomes(
        rows=[row for row in report.pairs.each if sizes.keys() >= set(row.pair)],
        angles=angles,
        sizes=sizes,
        config=config,
        selection=report.known_options.pairs,
        known_camera=report.known_options.intrinsics is not None,
    )
    models = [model.images for model in report.models]
    groups = photo_groups(sizes, pairs.rows)
    return dataclasses.replace(
        report,
        view_graph=view_graph_report(groups, models[0] if models else (), pairs),
        lost=_lost_photos(groups, models, pairs, _refused(report)),
        no_model=None if models else _no_model(pairs),
    )


def without_depth(report: RunReport, *, one_place: bool) -> RunReport:
    """The report of a run without a model because nothing gives depth: what to do is the same for
    all photos.

    Args:
      one_place: whether the photos were taken from one place. Otherwise something that shows the
        same in all photos may outweigh the rest.
    """
    if one_place:
        why, detail = f"{_ONE_PLACE}; {_MOVE}", "it shows no depth"
        help = Advice(option=None, reason=_MOVE)
    elif report.same_pixels is not None:
        why, detail = f"{report.no_model}, or {_MASK}", ""
        help = Advice(option="--masks", reason=_MASK)
    else:
        return report
    lost = [
        dataclasses.replace(each, stage="no pose", detail=detail or each.detail, help=[help])
        for each in report.lost
    ]
    return dataclasses.replace(report, lost=lost, no_model=why)


def _lost_photos(
    groups: Sequence[PhotoGroup],
    models: Sequence[Collection[str]],
    pairs: PairOutcomes,
    refused: dict[str, _Refused],
) -> list[LostPhoto]:
    """Every photo without a pose in the best model, with the stage that lost it.

    The stages, in the order of the pipeline:

    * `pairs`: no pair with the photo was tried;
    * `too few matches`: no pair had enough tentative matches;
    * `no plane`: no homography had enough inliers;
    * `not connected`: no chain of trusted pairs leads to the model;
    * `no pose`: trusted pairs lead to the model, but COLMAP found no pose;
    * `not confirmed`: COLMAP or registration found a pose, but something speaks against it;
    * `other model`: trusted pairs lead to the best model, but the photo is in a smaller one.
    """
    best_model = set(models[0]) if models else set()
    own_rows: dict[str, list[PairRow]] = {name: [] for name in pairs.sizes}
    for row in pairs.rows:
        for name in row.pair:
            own_rows[name].append(row)
    lost = []
    for index, group in enumerate(groups):
        connected = bool(group.images & best_model) or not best_model
        shared: list[Advice] | None = None  # all photos of an unconnected group get the same
        for name in group.images - best_model:
            own = own_rows[name]
            stage, detail = _stage(own, connected)
            smaller = next((k for k, images in enumerate(models) if k and name in images), None)
            if smaller is not None:
                stage = "other model" if stage == "no pose" else stage
                detail += f"; in the smaller model sparse/{smaller}"
            elif name in refused:
                stage = "not confirmed" if refused[name].had_pose else stage
                detail += f"; {refused[name].why}"
            if stage == "no pose":
                advice = without_pose(name, own, pairs, model=bool(models))
            elif stage == "not confirmed":
                advice = towards_others([name], own, pairs)
            elif stage == "other model":
                island = set(models[smaller or 0]) - best_model
                leaving = [row for row in pairs.rows if len(island & set(row.pair)) == 1]
                advice = towards_others(island, leaving, pairs)
            else:
                shared = shared or towards_others(group.images, group.crossing, pairs)
                advice = shared
            best = furthest(own)
            lost.append(
                LostPhoto(
                    image=name,
                    stage=stage,
                    detail=detail,
                    component=index,
                    model=smaller,
                    best_pair=None if best is None else pairs.closest(best),
                    help=advice,
                )
            )
    return sorted(lost, key=lambda photo: photo.image)


def _refused(report: RunReport) -> dict[str, _Refused]:
    """Why photos were taken out of a model or not registered in it, by name."""
    found = {
        name: _Refused(
            True, "the mapper gave it a pose, but something speaks against the model that it was in"
        )
        for check in report.checks
        if check
        for group in check.split_groups
        for name in group
    }
    rows = [at for each in report.refinement for at in (each.registrations if each else ())]
    # What registration says comes after the reason for which a photo was taken out.
    for at in sorted(rows, key=lambda at: bool(at.reason)):
        if at.reason:
            before = found.get(at.name)
            why = f"registration found no place that can be trusted: {at.reason}"
            found[at.name] = _Refused(
                had_pose=before is not None or at.candidates > 0,
                why=f"{before.why}; {why}" if before else why,
            )
        elif at.held is not None:
            lack = (
                f"alignment finds only {at.agreed} of the {at.candidates} points that it would "
                "show there"
                if at.candidates
                else f"too few of its {at.held} points are shown by a third photo of the model"
            )
            found[at.name] = _Refused(True, f"the mapper gave it a pose, but {lack}")
    return found


def _stage(own: Sequence[PairRow], connected: bool) -> tuple[Stage, str]:
    """The stage that lost a photo, and the numbers in words.

    Args:
      own: the pairs that were tried with the photo.
      connected: whether trusted pairs join the photo's group to the model.
    """
    if not own:
        return "pairs", "it is in no pair that was tried"
    tentative = max(row.tentative for row in own)
    if all(row.status == PairStatus.TOO_FEW_MATCHES for row in own):
        return "too few matches", f"at most {tentative} tentative matches in a pair"
    if not any(row.status == PairStatus.VERIFIED for row in own):
        return "no plane", (
            f"{tentative} tentative matches, but no homography agrees with enough of them"
        )
    used = [row.colmap_inliers for row in own if row.trusted]
    if used and connected:
        return "no pose", f"{len(used)} verified pairs with up to {max(used)} inliers"
    dropped = sum(row.outvoted for row in own)
    detail = (
        f"{max(row.inliers for row in own)} inliers in its best pair, {len(used)} pairs verified "
        "by COLMAP, none of which leads to the model"
    )
    if dropped:
        detail += f"; the view graph dropped {dropped} more (--view-graph no keeps them)"
    if rejected := sum(row.view_graph is not None and row.view_graph.rejected for row in own):
        detail += f"; the check of the model rejected {rejected} more"
    return "not connected", detail


def _no_model(pairs: PairOutcomes) -> str:
    """The one reason why there is no model: the stage that no pair got past, with the numbers."""
    rows = pairs.rows
    best = furthest(rows)
    if best is None:
        return "no pair of photos was tried"
    lack = f"the best, {describe(best.pair)}, has {pairs.missed(best)}"
    if not any(row.inliers for row in rows):
        return f"none of the {len(rows)} pairs tried has matches on a plane: {lack}"
    verified = sum(row.verified for row in rows)
    if not verified:
        handed_on = sum(row.handed_on for row in rows)
        return f"COLMAP verified none of the {handed_on} pairs handed to it: {lack}"
    used = [row for row in rows if row.trusted]
    best = furthest(used)
    if best is None:
        return f"the view graph trusts none of the {verified} verified pairs: {lack}"
    start = f"the mapper found no pair to start from among {len(used)}"
    widest = pairs.widest_deg(used)
    if widest is not None and widest < LOW_ANGLE_DEG:
        return (
            f"{start}: the rays of their points meet at {widest:.1f} deg at most, so nothing "
            f"gives depth; {_MOVE}"
        )
    return f"{start}; the best, {describe(best.pair)}, has {best.colmap_inliers} inliers"
