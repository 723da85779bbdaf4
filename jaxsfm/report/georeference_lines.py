"""What a report says of the move of its models into metres, as lines of the summary."""

from jaxsfm.io.images import named, shown_name
from jaxsfm.sfm.georeference.coordinate_system import Frame
from jaxsfm.sfm.georeference.georeference import Georeference
from jaxsfm.sfm.georeference.placement import MAX_TURN_DEG, Placement, Rms

MAX_NAMED = 5
"""The number of positions that disagree which are listed; report.json has all of them."""
FAR_PX = 10.0
"""A measurement of a control point further off than this is named, original pixels."""
LABEL = 17
"""The width of the labels of the summary, characters."""
WORDS = {"gps": "GPS positions", "positions": "positions", "control points": "control points"}


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


def _model_lines(found: Georeference, best: Placement) -> list[str]:
    if best.similarity is None or best.residual is None or found.frame is None:
        return [f"not moved        {best.why_not}"]
    used = len(best.anchors) - len(best.outliers)
    lines = [
        f"georeference     {frame_in_words(found.frame)}",
        f"moved onto       {used} of {len(best.anchors)} {WORDS[found.source]}; RMS of the "
        f"residuals: {_errors(best.residual)}",
    ]
    if best.held_out is not None:
        lines.append(f"each left out    RMS: {_errors(best.held_out)}")
    if (sigma := best.expected) is not None:
        east, north, up = sigma.shift
        lines.append(
            f"expected         deviation of the move: {max(east, north):.3f} m horizontal, "
            f"{up:.3f} m vertical, {sigma.turn_deg:.2f} deg, {100 * sigma.scale:.2g} % of the scale"
            + "; the direction is not certain"
            * (sigma.turn_deg > MAX_TURN_DEG)
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
