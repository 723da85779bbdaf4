"""Puts the page together and writes it."""

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path

import jinja2
import plotly.offline
from markupsafe import Markup

from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.images import MOST_NAMED, named, shown_name
from jaxsfm.io.pairs import describe
from jaxsfm.io.work_folder import PAGE
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.georeference_lines import georeference_lines, words_of
from jaxsfm.report.page.close_ups import SIDE, close_ups
from jaxsfm.report.page.error_figures import cumulative_figure, reprojection_figure, track_figure
from jaxsfm.report.page.figures import BLUE, GREEN, Figure, count, duration, figures3
from jaxsfm.report.page.matrices import matrix_figures
from jaxsfm.report.page.model_figure import model_figure
from jaxsfm.report.page.pair_pictures import pair_pictures
from jaxsfm.report.page.pair_states import component_table, pair_table
from jaxsfm.report.page.photo_table import photo_table
from jaxsfm.report.page.view_graph import view_graph
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.scene import shown_scene
from jaxsfm.report.typed_json import to_json
from jaxsfm.report.verdict import model_verdicts
from jaxsfm.sfm.georeference.placement import AnchorRow

MAX_FINDINGS = 5
"""The number of findings of each kind that the page lists for each model. Fifteen second places of
a rendered box filled the first screen."""
MAX_ANCHORS = 60
"""The number of measured positions in the table, those that are the furthest off."""
_ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("jaxsfm.report.page", "."),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {
    "name": shown_name,
    "named": named,
    "described": describe,
    "count": count,
    "figures3": figures3,
    "duration": duration,
    "quote": shlex.quote,
    "repr": repr,
}


def photo_names(report: RunReport) -> list[str]:
    """Every photo that is in a pair, in a model, or lost; sorted."""
    names = {name for row in report.pairs.each for name in row.pair}
    names |= {name for model in report.models for name in model.images}
    return sorted(names | {photo.image for photo in report.lost})


def _figures(run: FinishedRun, names: list[str]) -> Iterator[tuple[str, Figure]]:
    """The figures of the page, each with the name by which page.html places it."""
    report, rows = run.report, run.report.pairs.each
    if run.model is not None:
        yield "model", model_figure(shown_scene(run))
        yield "reprojection", reprojection_figure(run.errors)
        yield "tracks", track_figure(run.model.tracks)
    if evaluation := report.evaluation:
        total, errors = evaluation.reference_images, evaluation.images.values()
        positions, rotations = [e.position for e in errors], [e.rotation_deg for e in errors]
        unit = "units of the reference"
        yield "positions", cumulative_figure("position", unit, BLUE, positions, total)
        yield "rotations", cumulative_figure("rotation", "degrees", GREEN, rotations, total)
    if names:
        registered = set(report.models[0].images) if report.models else set()
        yield "view-graph", view_graph(names, rows, registered)
        yield from zip(("inliers", "states"), matrix_figures(names, rows), strict=True)


def _options(options: object, prefix: str = "") -> list[tuple[str, str]]:
    """Nested options as rows of a name and a value."""
    if isinstance(options, Mapping):
        return [row for name, each in options.items() for row in _options(each, f"{prefix}{name}.")]
    if isinstance(options, bool):
        options = "yes" if options else "no"
    return [(prefix.removesuffix("."), "-" if options is None else str(options))]


def _anchors(report: RunReport) -> list[AnchorRow]:
    """The measured positions of the best model, those that are the furthest off first."""
    found = report.georeference
    rows = found.models[0].anchors if found and found.models else []
    return sorted(rows, key=lambda row: -sum(each * each for each in row.residual))


def page(run: FinishedRun) -> str:
    """The report as HTML that needs nothing from outside."""
    report, images = run.report, run.photos.folder
    names = photo_names(report)
    pictures, photos = pair_pictures(run)
    anchors = _anchors(report)
    refinement = report.refinement[0] if report.refinement else None
    camera = refinement.camera if refinement else None
    return _ENVIRONMENT.get_template("page.html").render(
        title=shown_name(run.folder.absolute().name),
        plotly=Markup(plotly.offline.get_plotlyjs()),
        report=report,
        verdicts=model_verdicts(report.checked),
        camera=camera and camera.in_words(),
        most_findings=MAX_FINDINGS,
        named_photos=MOST_NAMED,
        reference=run.reference,
        georeference=[words_of(line) for line in georeference_lines(report.georeference)],
        anchors=anchors[:MAX_ANCHORS],
        anchors_left_out=len(anchors[MAX_ANCHORS:]),
        figures=dict(_figures(run, names)),
        pictures=pictures,
        photos=photos,
        tracks=close_ups(run),
        patch=SIDE,
        cell=FINE_STRIDE,
        pairs=pair_table(report.pairs.each),
        groups=component_table(report.view_graph),
        table=photo_table(run, names),
        options=_options(to_json(report.options)),
        out=str(run.folder.absolute()),
        images=images and str(images.absolute()),
    )


def write_page(
    folder: Path,
    *,
    images: Path | None = None,
    reference: Path | None = None,
    out: Path | None = None,
) -> Path:
    """Write the page of a finished run; returns its path.

    Args:
      folder, images, reference: as `jaxsfm.report.finished_run.read_run` takes them.
      out: where to write the page; default: report.html in `folder`.

    Raises:
      UserError: there is no finished run, or an argument cannot be used.
    """
    run = read_run(folder, images=images, reference=reference)
    path = out or folder / PAGE
    write_atomic(path, page(run).encode("utf-8", errors="replace"))
    return path
