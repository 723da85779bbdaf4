"""What a run did, as plain JSON and as the last lines on the screen; why images were lost."""

import dataclasses
from collections.abc import Collection, Container, Iterable, Mapping
from typing import Any

from jaxsfm.core.types import Status
from jaxsfm.host.images import shown_name
from jaxsfm.host.pairs import Pair, PairCounts, component_of
from jaxsfm.host.viewgraph import Verdict


def lost_images(
    names: Iterable[str],
    registered: Iterable[str],
    results: Mapping[Pair, PairCounts],
    verified: Mapping[Pair, int],
    untrusted: Collection[Pair] = (),
) -> list[dict[str, str]]:
    """For every image without a pose, the stage that lost it and the numbers behind that.

    Stages, in the pipeline's order: `pairs` (never paired), `too few matches` (no pair had enough
    tentative matches), `no plane` (no homography had enough inliers), `not connected` (no chain of
    COLMAP-verified pairs to the model), `no pose` (connected, but COLMAP found no pose).

    Args:
      results: every pair tried.
      verified: COLMAP's inliers, of every pair that has any.
      untrusted: those of them that the view graph dropped.
    """
    registered = set(registered)
    verified = {pair: count for pair, count in verified.items() if pair not in set(untrusted)}
    connected = component_of(registered, verified)
    lost = []
    for name in sorted(set(names) - registered):
        own = [result for pair, result in results.items() if name in pair]
        edges = [count for pair, count in verified.items() if name in pair]
        tentative = max((r.num_tentative for r in own), default=0)
        inliers = max((r.num_inliers for r in own), default=0)
        if not own:
            stage, detail = "pairs", "it is in no pair that was tried"
        elif all(r.status == Status.TOO_FEW_MATCHES for r in own):
            stage, detail = "too few matches", f"at most {tentative} tentative matches in a pair"
        elif not any(r.status == Status.VERIFIED for r in own):
            stage, detail = "no plane", f"{tentative} tentative matches, no homography among them"
        elif not edges or (registered and name not in connected):
            stage = "not connected"
            dropped = sum(name in pair for pair in untrusted)
            detail = (
                f"{inliers} inliers in its best pair, {len(edges)} pairs verified by COLMAP, "
                "none leads to the model"
                + (
                    f"; the view graph dropped {dropped} (--view-graph no keeps them)"
                    * bool(dropped)
                )
            )
        else:
            stage = "no pose"
            detail = f"{len(edges)} verified pairs with up to {max(edges)} inliers"
        lost.append({"image": name, "stage": stage, "detail": detail})
    return lost


def model_figures(model: Any) -> dict[str, Any]:
    """The numbers of one COLMAP model."""
    return {
        "registered": model.num_reg_images(),
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "track_length": model.compute_mean_track_length(),
        "reprojection_error_px": model.compute_mean_reprojection_error(),
        "images": sorted(model.image(i).name for i in model.reg_image_ids()),
    }


def evaluation_lines(evaluation: Mapping[str, Any]) -> list[str]:
    """An evaluation as text."""
    position, rotation = evaluation["position"], evaluation["rotation_deg"]
    shares = ", ".join(f"{d}: {100 * s:.0f} %" for d, s in evaluation["within_10deg"].items())
    return [
        f"reference        {evaluation['registered']} of {evaluation['reference_images']} images, "
        f"aligned on {evaluation['aligned_on']}",
        *(
            f"{label} mean {e['mean']:.4f}  median {e['median']:.4f}  max {e['max']:.4f} {unit}"
            for label, e, unit in (
                ("position error  ", position, "(units of the reference)"),
                ("rotation error  ", rotation, "deg"),
            )
        ),
        f"within (d; 10 deg)  {shares}",
    ]


def summary_lines(report: Mapping[str, Any]) -> list[str]:
    """The run's last words."""
    images, pairs = report["images"], report["pairs"]
    lines = [
        f"images           {images['usable']} usable of {images['found']}",
        f"pairs            {pairs['tried']} tried, {pairs['verified']} verified, "
        f"{pairs['handed_on']} handed to COLMAP"
        + (f", {pairs['trusted']} trusted" if pairs["trusted"] is not None else ""),
    ]
    if given := report.get("given"):
        lines.append(
            f"given            {given['matches']} matches in {given['pairs']} pairs of "
            f"{given['images']} images, mapped beside"
        )
    models = report["models"]
    if models:
        best = models[0]
        lines += [
            f"registered       {best['registered']} of {images['usable']} images"
            + (
                f" (and {len(models) - 1} smaller model{'s' * (len(models) > 2)})"
                if len(models) > 1 and best["registered"] < images["usable"]
                else ""
            ),
            f"points           {best['points']}, mean track length {best['track_length']:.2f}, "
            f"reprojection error {best['reprojection_error_px']:.2f} px",
        ]
    else:
        lines.append("registered       none: no model could be built")
    attempts = report["mapping"]
    if len(attempts) > 1:
        tries = ", ".join(str(max(a["registered"], default=0)) for a in attempts)
        lines.append(f"mapping          started {len(attempts)} times, images registered: {tries}")
    refinement = report["refinement"][0] if report["refinement"] else None
    if refinement and refinement["passes"]:
        last = refinement["passes"][-1]
        lines.append(
            f"refinement       {last['kept']} observations agreed, {last['dropped']} dropped, "
            f"{last['added']} added in the last of {len(refinement['passes'])} passes"
            + ("" if last["accepted"] else "; too few, taken back")
        )
        for at in refinement["placed"]:
            if not at["registered"] and not at["octave_px"]:
                continue  # it is among the lost
            name, px = shown_name(at["name"]), at["octave_px"]
            lines.append(
                f"placed           {name}: {at['agreed']} points agree at "
                f"{'full' if px == 1 else f'1/{px}'} size, {at['error_px']:.1f} px"
                + ("" if at["registered"] else "; the mapper had left it out")
                if px
                else f"not refined      {name}: too few points agree; the old observations stay"
            )
    seconds = report["seconds"]
    lines.append("seconds          " + ", ".join(f"{k} {v:.1f}" for k, v in seconds.items()))
    if pairs["overflowed"]:
        lines.append(f"warning          {pairs['overflowed']} pairs had more matches than kept")
    lines += [f"skipped          {reason}" for reason in images["skipped"].values()]
    lines += [
        f"lost             {shown_name(row['image'])}: {row['stage']} ({row['detail']})"
        for row in report["lost"]
    ]
    if report.get("evaluation"):
        lines += evaluation_lines(report["evaluation"])
    if report.get("evaluation_failed"):
        lines.append(f"not evaluated    {report['evaluation_failed']}")
    return lines


def pair_figures(
    pair: Pair,
    counts: PairCounts,
    chosen: Container[Pair],
    verified: dict[Pair, int],
    verdicts: dict[Pair, Verdict],
) -> dict[str, Any]:
    """A pair's part of the report, plain JSON."""
    verdict = verdicts.get(pair)
    return {
        "pair": list(pair),
        "status": counts.status.name.lower(),
        "tentative": counts.num_tentative,
        "inliers": counts.num_inliers,
        "planes": counts.num_planes,
        "handed_on": pair in chosen,
        "colmap_inliers": verified.get(pair, 0),
        "view_graph": None if verdict is None else dataclasses.asdict(verdict),
    }
