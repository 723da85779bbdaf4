"""Puts the page together and writes it."""

from collections.abc import Iterator
from pathlib import Path

import jinja2
import plotly.offline
from markupsafe import Markup

from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.images import shown_name
from jaxsfm.io.work_folder import PAGE
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.page.close_ups import SIDE, close_ups
from jaxsfm.report.page.error_figures import cumulative_figures, reprojection_figure, track_figure
from jaxsfm.report.page.figures import Figure, count, figures3
from jaxsfm.report.page.matrices import matrix_figures
from jaxsfm.report.page.model_figure import model_figure
from jaxsfm.report.page.pair_pictures import pair_pictures
from jaxsfm.report.page.pair_table import component_table, pair_table
from jaxsfm.report.page.photo_table import photo_table
from jaxsfm.report.page.run_tables import next_steps, option_table, stage_table
from jaxsfm.report.page.verdict import verdict
from jaxsfm.report.page.view_graph import view_graph
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.scene import shown_scene
from jaxsfm.report.typed_json import to_json

_ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("jaxsfm.report.page", "."),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters["name"] = shown_name
_ENVIRONMENT.filters["count"] = count
_ENVIRONMENT.filters["figures3"] = figures3


def _text(file: str) -> str:
    """The content of a file of this package."""
    found = _ENVIRONMENT.loader
    assert found is not None
    return found.get_source(_ENVIRONMENT, file)[0]


def photo_names(report: RunReport) -> list[str]:
    """Every photo that is in a pair, in a model, or lost; sorted."""
    names = {name for row in report.pairs.each for name in row.pair}
    names |= {name for model in report.models for name in model.images}
    return sorted(names | {photo.image for photo in report.lost})


def _figures(run: FinishedRun, names: list[str]) -> Iterator[Figure]:
    report, rows = run.report, run.report.pairs.each
    if run.model is not None:
        unit = "units of the reference" if run.reference else "the model's own, arbitrary units"
        yield model_figure(shown_scene(run), unit)
        yield reprojection_figure(run.model)
        yield track_figure(run.model)
    if report.evaluation:
        yield from cumulative_figures(report.evaluation)
    if names:
        registered = set(report.models[0].images) if report.models else set()
        yield view_graph(names, rows, registered)
        yield from matrix_figures(names, rows)


def page(run: FinishedRun) -> str:
    """The report as HTML that needs nothing from outside."""
    report = run.report
    names = photo_names(report)
    pictures, photos = pair_pictures(run)
    return _ENVIRONMENT.get_template("page.html").render(
        title=shown_name(run.folder.absolute().name),
        style=Markup(_text("page.css")),
        script=Markup(_text("page.js")),
        plotly=Markup(plotly.offline.get_plotlyjs()),
        verdict=verdict(report),
        figures={figure.id: figure for figure in _figures(run, names)},
        pictures=pictures,
        photos=photos,
        tracks=close_ups(run),
        patch=SIDE,
        cell=FINE_STRIDE,
        pairs=pair_table(report.pairs.each),
        groups=component_table(report.view_graph),
        table=photo_table(run, names),
        seconds=stage_table(report.seconds),
        options=option_table(to_json(report.options)),
        versions=report.versions or {"jaxsfm": report.version},
        finished=report.finished,
        evaluation=report.evaluation,
        folder=shown_name(str(run.folder.absolute())),
        images=run.photos.folder and shown_name(str(run.photos.folder.absolute())),
        steps=next_steps(run.folder, run.photos.folder, model=run.model is not None),
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
