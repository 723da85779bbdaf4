"""The summary of a run: the last lines on the screen. It also says how the models were moved into
metres."""

from collections.abc import Sequence

from jaxsfm.io.images import named, shown_name
from jaxsfm.io.pairs import describe
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.run_results import EvaluationReport, LostPhoto, ViewGraph
from jaxsfm.report.verdict import model_verdicts, verdict_lines
from jaxsfm.sfm.georeference.coordinate_system import Frame
from jaxsfm.sfm.georeference.georeference import Georeference
from jaxsfm.sfm.georeference.model_georeference import MAX_TURN_DEG, ModelGeoreference, Rms
from jaxsfm.sfm.refine.passes import RefinementFigures

MAX_GROUPS = 10
"""The number of groups of photos that are listed; report.json has all of them."""
MAX_NAMED = 5
"""The number of positions that disagree which are listed; report.json has all of them."""
FAR_PX = 10.0
"""A measurement of a control point further off than this is named, original pixels."""
LABEL = 17
"""The width of the labels of the summary, characters."""
WORDS = {"gps": "GPS positions", "positions": "positions", "control points": "control points"}


def evaluation_lines(evaluation: EvaluationReport) -> list[str]:
    """An evaluation as text."""
    shares = ", ".join(f"{d}: {100 * s:.0f} %" for d, s in evaluation.within_10deg.items())
    return [
        f"reference        {evaluation.registered} of {evaluation.reference_images} images, "
        f"aligned on {evaluation.aligned_on}",
        *(
            f"{label} mean {e.mean:.4f}  median {e.median:.4f}  max {e.max:.4f} {unit}"
            for label, e, unit in (
                ("position error  ", evaluation.position, "(units of the reference)"),
                ("rotation error  ", evaluation.rotation_deg, "deg"),
            )
        ),
        f"within 10 deg    and a distance of {shares} (units of the reference)",
    ]


def component_lines(view_graph: ViewGraph) -> list[str]:
    """The groups of photos that trusted pairs join, and what keeps them apart; nothing if there is
    one group only."""
    groups = view_graph.components
    several = [group for group in groups if len(group.images) > 1]
    if len(several) < 2:
        return []
    alone = len(groups) - len(several)
    sizes = ", ".join(str(len(group.images)) for group in several[:MAX_GROUPS])
    lines = [
        f"view graph       {len(several)} groups of {sizes}"
        + ", ..." * (len(several) > MAX_GROUPS)
        + " images"
        + f"; {alone} images alone" * bool(alone)
        + "; no trusted pair joins two groups"
    ]
    for group in several[1:MAX_GROUPS]:
        near = group.nearest
        lines.append(
            f"group            {named(group.images)}: "
            + (
                f"the pair nearest to the others is {describe(near.pair)}: {near.missed}"
                if near
                else "no pair with any other image was tried"
            )
        )
    return lines


def help_lines(lost: Sequence[LostPhoto]) -> list[str]:
    """What could help the lost photos: each option once, with the photos that it could help."""
    helped: dict[str | None, dict[str, str]] = {}
    for photo in lost:
        for advice in photo.help or ():
            helped.setdefault(advice.option, {})[photo.image] = advice.reason
    lines = []
    for option in sorted(helped, key=lambda option: (option is None, option)):
        images, reasons = list(helped[option]), list(helped[option].values())
        first = f"for {shown_name(images[0])}, " * (len(set(reasons)) > 1) + reasons[0]
        lines.append(f"may help         {option or 'more photos'} ({named(images)}): {first}")
    return lines


def refinement_lines(refinement: RefinementFigures) -> list[str]:
    """What the refinement of the best model did."""
    last = refinement.passes[-1]
    lines = [
        f"refinement       {last.kept} observations agreed, {last.dropped} dropped, "
        f"{last.added} added in the last of {len(refinement.passes)} passes"
        + ("" if last.accepted else "; too few agreed, so this pass was taken back")
    ]
    for at in refinement.registrations:
        name, px = shown_name(at.name), at.octave_px
        if px and not at.reason:
            lines.append(
                f"registered       {name}: {at.agreed} points agree at "
                f"{'full' if px == 1 else f'1/{px}'} size, with a median error of "
                f"{at.error_px:.1f} px" + ("" if at.registered else "; it had no place before")
            )
        elif at.registered and at.held is None:  # all others are among the lost photos
            lines.append(
                f"not refined      {name}: too few points agree; it keeps the observations of the "
                "mapper"
            )
    if refinement.camera is not None:
        lines.append(f"camera           {refinement.camera.in_words()}")
    return lines


def summary_lines(report: RunReport) -> list[str]:
    """What a run did. If there is no model, the reason comes first."""
    images, pairs, models = report.images, report.pairs, report.models
    lines = [] if report.no_model is None else [f"no model         {report.no_model}"]
    lines += [
        f"images           {images.usable} usable of {images.found}",
        f"pairs            {pairs.tried} tried, {pairs.verified} verified, "
        f"{pairs.handed_on} handed to COLMAP"
        + (f", {pairs.trusted} trusted" if pairs.trusted is not None else ""),
    ]
    if low_resolution := report.low_resolution:
        lines.append(f"low resolution   {low_resolution.in_words()}")
    if turned := report.turned:
        each = [f"{shown_name(name)} by {degrees} deg" for name, degrees in turned.items()]
        lines.append(f"turned           {named(each)} clockwise, to stand as the others do")
    if given := report.given:
        lines.append(
            f"given            {given.matches} matches in {given.pairs} pairs of {given.images} "
            "images, mapped together with the run's own"
        )
    if same := report.same_pixels:
        lines.append(f"same pixels      {same.in_words()}")
    if placed := report.panoramas:
        lines.append(
            f"panoramas        {placed.registered} of {placed.found} have a place in the model; "
            "their views are counted as images"
        )
    if models:
        best, others = models[0], len(models) - 1
        smaller = f" (and {others} smaller model{'s' * (others > 1)})"
        lines += [
            f"registered       {best.registered} of {images.usable} images"
            + smaller * (others > 0 and best.registered < images.usable),
            f"points           {best.points}, mean track length {best.track_length:.2f}, "
            f"reprojection error {best.reprojection_error_px:.2f} px",
        ]
    else:
        lines.append(f"registered       none of {images.usable} images")
    if len(report.mapping) > 1:
        tries = ", ".join(str(max(each.registered, default=0)) for each in report.mapping)
        lines.append(
            f"mapping          started {len(report.mapping)} times, images registered: {tries}"
        )
    refinement = report.refinement[0] if report.refinement else None
    if refinement and refinement.passes:
        lines += refinement_lines(refinement)
    lines += georeference_lines(report.georeference)
    lines += verdict_lines(model_verdicts(report.checked))
    if contradicted_positions(report):
        lines.append(f"positions        {CONTRADICTED}")
    lines.append("seconds          " + ", ".join(f"{k} {v:.1f}" for k, v in report.seconds.items()))
    if pairs.overflowed:
        lines.append(
            f"warning          {pairs.overflowed} pairs had more matches than could be kept"
        )
    lines += component_lines(report.view_graph)
    lines += [f"skipped          {reason}" for reason in images.skipped.values()]
    lines += [
        f"lost             {shown_name(photo.image)}: {photo.stage} ({photo.detail})"
        for photo in report.lost
    ]
    lines += help_lines(report.lost)
    if report.evaluation:
        lines += evaluation_lines(report.evaluation)
    if report.evaluation_failed:
        lines.append(f"not evaluated    {report.evaluation_failed}")
    return lines


def contradicted_positions(report: RunReport) -> bool:
    """Whether the photos contradict the measured positions of a file."""
    found = report.georeference
    return found is not None and any(each.contradicted for each in found.models)


CONTRADICTED = (
    "amber: the photos contradict the file of --georeference, so the model has no scale; correct "
    "the file, and run the same command again: only the move is made anew"
)
"""What follows from positions that contradict the photos."""


def frame_in_words(frame: Frame) -> str:
    """The axes of a frame and where its origin lies."""
    where = ""
    if frame.origin is not None:
        lat, lon, height = frame.origin
        where = f" from latitude {lat:.7f}, longitude {lon:.7f}, height {height:.2f}"
    if any(frame.offset):
        x, y, z = frame.offset
        where = f" of {frame.system or 'the file'}, minus ({x:.0f}, {y:.0f}, {z:.0f})"
    return f"metres, {frame.axes}{where}"


def _errors(rms: Rms) -> str:
    return (
        f"east {rms.east:.3f}, north {rms.north:.3f}, up {rms.up:.3f}, horizontal "
        f"{rms.horizontal:.3f} m"
    )


def georeference_lines(found: Georeference | None) -> list[str]:
    """How the models were moved, and how well the measured positions agree."""
    if found is None or found.frame is None or not found.models:
        placed = found.models if found else []
        return [f"not moved        {placed[0].why_not}"] if placed else []
    best, *others = found.models
    lines = _model_lines(found, best)
    for number, other in enumerate(others, start=1):
        what = f"moved, horizontal {other.residual.horizontal:.3f} m" if other.residual else "no"
        lines.append(f"model {number}          {what if other.similarity else other.why_not}")
    return lines


def _model_lines(found: Georeference, best: ModelGeoreference) -> list[str]:
    if best.similarity is None or best.residual is None or found.frame is None:
        return [f"not moved        {best.why_not}"]
    used = len(best.anchors) - len(best.outliers)
    lines = [
        f"georeference     {frame_in_words(found.frame)}",
        f"moved onto       {used} of {len(best.anchors)} {WORDS[found.source]}; RMS of the "
        f"residuals: {_errors(best.residual)}",
    ]
    if best.held_out is not None:
        label = "fifth left out" if best.inside and best.inside.kept else "each left out"
        lines.append(f"{label:<16} RMS: {_errors(best.held_out)}")
    if (inside := best.inside) is not None:
        before, after = (_errors(each) for each in (inside.moved_only, inside.adjusted))
        lines.append(
            "positions inside a last adjustment; a fifth left out in turn, RMS of the residuals: "
            f"{after}; after the move alone: {before}"
            + "; it was dropped, because these fit no better"
            * (not inside.kept)
        )
    if (sigma := best.expected) is not None:
        east, north, up = sigma.shift
        lines.append(
            f"expected         deviation of the move: {max(east, north):.3f} m horizontal, "
            f"{up:.3f} m vertical, {sigma.turn_deg:.2f} deg, {100 * sigma.scale:.2g} % of the scale"
            + "; the direction is not certain"
            * (sigma.turn_deg > MAX_TURN_DEG)
        )
    if best.upside_down:
        lines.append(
            "upside down      most cameras hang upside down in these coordinates: if the photos "
            "were taken upright, heights count downwards, or an axis is exchanged or has the "
            "other sign"
        )
    wrong = [row for row in best.anchors if not row.used]
    for row in wrong[:MAX_NAMED]:
        x, y, z = row.residual
        lines.append(
            f"outlier          {shown_name(row.name)}: {(x * x + y * y + z * z) ** 0.5:.2f} m from "
            "where the others put it; not used"
        )
    if len(wrong) > MAX_NAMED:
        lines.append(f"outliers         {len(wrong) - MAX_NAMED} more are in report.json")
    for row in best.anchors:
        for photo, px in row.errors_px.items():
            if px > FAR_PX:
                lines.append(
                    f"measurement      {shown_name(row.name)} in {shown_name(photo)} is "
                    f"{px:.0f} px from where the model has the point"
                )
    for why in sorted(set(best.unused.values())):
        names = [name for name, each in best.unused.items() if each == why]
        lines.append(f"not used         {named(names)}: {why}")
    return lines


def words_of(line: str) -> str:
    """A line of the summary as a sentence: its label, a colon, and its text."""
    label, text = line[:LABEL].strip(), line[LABEL:]
    return f"{label[:1].upper()}{label[1:]}: {text}."
