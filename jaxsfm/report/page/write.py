"""Puts the page together and writes it."""

import shlex
from collections.abc import Mapping
from pathlib import Path

import jinja2
import numpy as np
import plotly.offline
from markupsafe import Markup

from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.entries import FAILED, PAGE, RECORD, entry
from jaxsfm.io.images import MOST_NAMED, shown_name
from jaxsfm.io.pairs import describe
from jaxsfm.report.finished_run import FinishedRun, read_run
from jaxsfm.report.page.figures import figures
from jaxsfm.report.page.pairs import pair_pictures, pair_table
from jaxsfm.report.page.photos import photo_table
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.summary import component_lines, georeference_lines, words_of
from jaxsfm.report.verdict import model_verdicts
from jaxsfm.sfm.georeference.model_georeference import AnchorRow

MAX_FINDINGS = 5
"""The number of findings of each kind that the page lists for each model. Fifteen second places of
a rendered box filled the first screen."""
MAX_ANCHORS = 60
"""The number of measured positions in the table, those that are the furthest off."""


def count(n: int) -> str:
    """A number with thin spaces between thousands."""
    return f"{n:,}".replace(",", "\u202f")


def figures3(value: float) -> str:
    """A number with three significant figures, never as a power of ten."""
    return np.format_float_positional(value, precision=3, fractional=False, trim="-")


def duration(seconds: float) -> str:
    """A time in its two largest units."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


_ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("jaxsfm.report.page", "."),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {
    "name": shown_name,
    "described": describe,
    "count": count,
    "figures3": figures3,
    "duration": duration,
    "quote": shlex.quote,
    "repr": repr,
}


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
        figures=dict(figures(run)),
        pictures=pictures,
        photos=photos,
        pairs=pair_table(report.pairs.each),
        groups=[words_of(line) for line in component_lines(report.view_graph)],
        table=photo_table(run),
        options=_options(report.options),
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
    if folder.name == FAILED and (folder.parent / RECORD).is_file():
        folder = entry(folder.parent, FAILED)
    path = out or folder / PAGE
    write_atomic(path, page(run).encode("utf-8", errors="replace"))
    return path
