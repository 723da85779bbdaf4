"""Everything of the page put together and written."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jinja2
import plotly.offline
from markupsafe import Markup

from jaxsfm.core.grid import FINE_STRIDE
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.images import shown_name
from jaxsfm.io.work_folder import PAGE
from jaxsfm.report.finished_run import KeptRun, read_run
from jaxsfm.report.page import close_ups, tables
from jaxsfm.report.page.error_figures import cumulative_figures, reprojection_figure, track_figure
from jaxsfm.report.page.figures import Figure, count, figures3
from jaxsfm.report.page.matrices import matrix_figures
from jaxsfm.report.page.model_figure import model_figure
from jaxsfm.report.page.pair_pictures import pair_pictures
from jaxsfm.report.page.view_graph import view_graph
from jaxsfm.report.scene import shown_scene

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
    """A file of this package."""
    found = _ENVIRONMENT.loader
    assert found is not None
    return found.get_source(_ENVIRONMENT, file)[0]


def image_names(report: dict[str, Any]) -> list[str]:
    """Every image that was paired, registered or lost, sorted."""
    names = {name for row in report["pairs"]["each"] for name in row["pair"]}
    names |= {name for model in report["models"] for name in model["images"]}
    return sorted(names | {row["image"] for row in report["lost"]})


def _figures(run: KeptRun, names: list[str]) -> Iterator[Figure]:
    rows = run.report["pairs"]["each"]
    if run.model is not None:
        unit = "units of the reference" if run.reference else "the model's own, arbitrary units"
        yield model_figure(shown_scene(run), unit)
        yield reprojection_figure(run.model)
        yield track_figure(run.model)
    if run.report.get("evaluation"):
        yield from cumulative_figures(run.report["evaluation"])
    if names:
        registered = set(run.report["models"][0]["images"]) if run.report["models"] else set()
        yield view_graph(names, rows, registered)
        yield from matrix_figures(names, rows)


def page(run: KeptRun) -> str:
    """The report as HTML, with all that it needs inside."""
    report = run.report
    names = image_names(report)
    pictures, photos = pair_pictures(run)
    # A page that is written early in a run's life has no later keys: older runs lack some.
    return _ENVIRONMENT.get_template("page.html").render(
        title=shown_name(run.folder.absolute().name),
        style=Markup(_text("page.css")),
        script=Markup(_text("page.js")),
        plotly=Markup(plotly.offline.get_plotlyjs()),
        verdict=tables.verdict(report),
        figures={figure.id: figure for figure in _figures(run, names)},
        pictures=pictures,
        photos=photos,
        tracks=close_ups.close_ups(run),
        patch=close_ups.SIDE,
        cell=FINE_STRIDE,
        pairs=tables.pair_table(report["pairs"]["each"]),
        groups=tables.component_table(report),
        table=tables.photo_table(run, names),
        seconds=tables.stage_table(report["seconds"]),
        options=tables.flat(report["options"]),
        versions=report.get("versions") or {"jaxsfm": report["version"]},
        finished=report.get("finished", ""),
        evaluation=report.get("evaluation"),
        folder=shown_name(str(run.folder.absolute())),
        images=run.photos.folder and shown_name(str(run.photos.folder.absolute())),
        steps=tables.next_steps(run.folder, run.photos.folder, model=run.model is not None),
    )


def write_page(
    folder: Path,
    *,
    images: Path | None = None,
    reference: Path | None = None,
    out: Path | None = None,
) -> Path:
    """Write the page of a finished run; returns its path, by default OUT/report.html.

    Args:
      folder, images, reference: see `jaxsfm.report.finished_run.read_run`.

    Raises:
      UserError: no finished run, or what was named cannot be used.
    """
    run = read_run(folder, images=images, reference=reference)
    path = out or folder / PAGE
    write_atomic(path, page(run).encode("utf-8", errors="replace"))
    return path
