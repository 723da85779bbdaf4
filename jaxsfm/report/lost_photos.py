"""Why images were lost, or no model came out: where, with which numbers, and what may help."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import Pair, describe
from jaxsfm.report.advice import LEAST_ANGLE_DEG, Circumstances, Help, towards_others, without_pose
from jaxsfm.report.pair_outcomes import Component, PairOutcomes, components


def explained(
    models: Sequence[Collection[str]],
    pairs: PairOutcomes,
    made: Circumstances,
    refinement: Sequence[Mapping[str, Any] | None] = (),
) -> dict[str, Any]:
    """The report's `view_graph`, `lost` and `no_model`, plain JSON.

    Args:
      models: each one's images, the best first.
      refinement: the report's, of each model.
    """
    groups = components(made.sizes, pairs)
    return {
        "view_graph": {"components": _component_rows(groups, models, pairs)},
        "lost": lost_images(groups, models, pairs, made, _taken_out(refinement)),
        "no_model": None if models else no_model(pairs),
    }


def lost_images(
    groups: Sequence[Component],
    models: Sequence[Collection[str]],
    pairs: PairOutcomes,
    made: Circumstances,
    taken_out: Mapping[str, str],
) -> list[dict[str, Any]]:
    """For every image without a pose in the best model, the stage that lost it and the numbers.

    Stages, in the pipeline's order: `pairs` (never paired), `too few matches` (no pair had enough
    tentative matches), `no plane` (no homography had enough inliers), `not connected` (no chain of
    trusted pairs to the model), `no pose` (connected, but COLMAP found no pose), `not confirmed`
    (COLMAP found one, and refinement took it out of the model again), `other model` (it is in a
    smaller one, though trusted pairs lead to the best).

    Args:
      taken_out: why refinement took images out of a model.
    """
    best_model = set(models[0]) if models else set()
    own: dict[str, list[Pair]] = {name: [] for name in made.sizes}
    for pair in pairs.results:
        for name in own.keys() & set(pair):
            own[name].append(pair)
    rows = []
    for index, group in enumerate(groups):
        connected = bool(group.images & best_model) or not best_model
        advice: list[Help] | None = None  # of a group that is not connected: the same for all of it
        for name in sorted(group.images - best_model):
            stage, detail = _stage(name, own[name], connected, pairs)
            smaller = next((k for k, images in enumerate(models) if k and name in images), None)
            if smaller is not None:
                stage = "other model" if stage == "no pose" else stage
                detail += f"; in the smaller model sparse/{smaller}"
            elif name in taken_out:
                stage, detail = "not confirmed", f"{detail}; {taken_out[name]}"
            if stage == "no pose":
                found = without_pose(name, own[name], pairs, made, model=bool(models))
            elif stage == "not confirmed":
                found = towards_others([name], own[name], pairs, made)
            elif stage == "other model":
                island = set(models[smaller or 0]) - best_model
                found = towards_others(island, _leaving(island, pairs), pairs, made)
            else:
                advice = advice or towards_others(group.images, group.crossing, pairs, made)
                found = advice
            best = pairs.best(own[name])
            rows.append(
                {
                    "image": name,
                    "stage": stage,
                    "detail": detail,
                    "component": index,
                    "model": smaller,
                    "best_pair": best and pairs.row(best),
                    "help": [each._asdict() for each in found],
                }
            )
    return sorted(rows, key=lambda row: row["image"])


def _taken_out(refinement: Sequence[Mapping[str, Any] | None]) -> dict[str, str]:
    """Why refinement took images out of a model."""
    return {
        at["name"]: (
            f"the mapper gave it a pose, but alignment finds {at['agreed']} of the "
            f"{at['candidates']} points that it should show, and {at['held']} points hold it"
        )
        for each in refinement
        for at in (each["placed"] if each else ())
        if at.get("held") is not None
    }


def _leaving(images: Collection[str], pairs: PairOutcomes) -> list[Pair]:
    """Pairs tried between some images and all others."""
    return [pair for pair in pairs.results if (pair[0] in images) != (pair[1] in images)]


def _stage(name: str, own: Sequence[Pair], connected: bool, pairs: PairOutcomes) -> tuple[str, str]:
    """Where an image was lost, and the numbers in words."""
    results = [pairs.results[pair] for pair in own]
    tentative = max((r.num_tentative for r in results), default=0)
    if not own:
        return "pairs", "it is in no pair that was tried"
    if all(r.status == Status.TOO_FEW_MATCHES for r in results):
        return "too few matches", f"at most {tentative} tentative matches in a pair"
    if not any(r.status == Status.VERIFIED for r in results):
        return "no plane", f"{tentative} tentative matches, no homography among them"
    used = [pairs.verified[pair] for pair in own if pairs.trusted(pair)]
    if used and connected:
        return "no pose", f"{len(used)} verified pairs with up to {max(used)} inliers"
    dropped = sum(pair in pairs.verified for pair in own) - len(used)
    return "not connected", (
        f"{max(r.num_inliers for r in results)} inliers in its best pair, {len(used)} pairs "
        "verified by COLMAP, none leads to the model"
        + f"; the view graph dropped {dropped} (--view-graph no keeps them)"
        * bool(dropped)
    )


def _component_rows(
    groups: Sequence[Component], models: Sequence[Collection[str]], pairs: PairOutcomes
) -> list[dict[str, Any]]:
    of = {name: k for k, group in enumerate(groups) for name in group.images}
    rows = []
    for group in groups:
        best = pairs.best(group.crossing)
        other = best and of[best[best[0] in group.images]]
        rows.append(
            {
                "images": sorted(group.images),
                "pairs": group.pairs,
                "registered": len(group.images & set(models[0])) if models else 0,
                "nearest": best and {"component": other, **pairs.row(best)},
            }
        )
    return rows


def no_model(pairs: PairOutcomes) -> str:
    """The one reason that decided: the stage that no pair got past, with the numbers."""
    best = pairs.best(pairs.results)
    if best is None:
        return "no pair of photos was tried"
    lack = f"the best, {describe(best)}, has {pairs.missed(best)}"
    if not any(result.num_inliers for result in pairs.results.values()):
        return f"none of the {len(pairs.results)} pairs tried has matches on a plane: {lack}"
    if not pairs.verified:
        return f"COLMAP verified none of the {len(pairs.handed_on)} pairs handed to it: {lack}"
    used = [pair for pair in pairs.verified if pairs.trusted(pair)]
    if not used:
        return f"the view graph trusts none of the {len(pairs.verified)} verified pairs: {lack}"
    start = f"the mapper found no pair to start from among {len(used)}"
    widest = pairs.widest_deg(used)
    if widest is not None and widest < LEAST_ANGLE_DEG:
        return (
            f"{start}: the rays of their points meet at {widest:.1f} deg at most, so nothing "
            "gives depth; move sideways between photos"
        )
    best = pairs.best(used)
    assert best is not None
    return f"{start}; the best, {describe(best)}, has {pairs.verified[best]} inliers"
