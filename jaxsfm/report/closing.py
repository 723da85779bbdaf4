"""The last lines of a run: is the model good, where to look, and what to do next.

They are for people who read nothing else. The lines of the summary above them have the figures.
"""

from collections.abc import Sequence
from pathlib import Path

from jaxsfm.io.entries import PAGE
from jaxsfm.io.images import shown_name
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.run_results import LostPhoto
from jaxsfm.report.summary import contradicted_positions
from jaxsfm.report.verdict import ModelVerdict, model_verdicts
from jaxsfm.sfm.check.model_check import MIN_VIEWS

MORE_PHOTOS = "take more photos, each a step to the side of the one before"
"""What always helps: neighbours that overlap, from different places."""


def closing_lines(report: RunReport, results: Path) -> list[str]:
    """The three lines, as their labels and sentences.

    Args:
      results: the folder with the report and the models of the run.
    """
    worst = _worst(model_verdicts(report.checked))
    return [
        f"is it good?      {_good(report, worst)}",
        f"where to look    {_where(report, results)}",
        f"what to do next  {_next(report, worst, results)}",
    ]


def _worst(verdicts: Sequence[ModelVerdict]) -> ModelVerdict | None:
    """The worst verdict, of equal ones the first; None if nothing speaks against any model."""
    for colour in ("red", "amber"):
        for verdict in verdicts:
            if verdict.colour == colour:
                return verdict
    return None


def _good(report: RunReport, worst: ModelVerdict | None) -> str:
    if not report.models:
        return "no: there is no model"
    placed, usable = report.models[0].registered, report.images.usable
    missing = usable - placed
    lack = f"{missing} of {usable} photos {'has' if missing == 1 else 'have'} no place in it"
    if worst is not None:
        said = worst.headline.removeprefix(f"{worst.colour}: ")
        return f"{'no' if worst.colour == 'red' else 'perhaps not'}: {said}"
    if contradicted_positions(report):
        return "perhaps not: the photos contradict the file of --georeference"
    if not report.checked:
        why = (
            f"two photos cannot contradict each other; it takes {MIN_VIEWS} to check a model"
            if placed < MIN_VIEWS
            else "it was not checked"
        )
        return f"nobody knows: {why}" + f", and {lack}" * bool(missing)
    if missing:
        return f"in part: no photo contradicts it, but {lack}"
    return f"yes: all {usable} photos have a place in it, and no photo contradicts it"


def _where(report: RunReport, results: Path) -> str:
    page = results / PAGE
    if not page.is_file():
        return f"{results / 'report.json'} (the page could not be written)"
    shows = "shows the model and its photos" if report.models else "shows the photos and pairs"
    missing = report.lost or not report.models
    why = ", and says why photos are missing" if missing else ""
    return f"{page}, in a browser: it {shows}{why}"


def _next(report: RunReport, worst: ModelVerdict | None, results: Path) -> str:
    if worst is not None:
        return worst.advice
    if contradicted_positions(report):
        return "correct the file, and run the same command again"
    if report.lost:
        return _for_lost(report.lost)
    if not report.models or report.models[0].registered < MIN_VIEWS:
        return f"{MORE_PHOTOS}, and run the same command again"
    return (
        f"use the model in {results / 'sparse' / '0'}, or write it for another program: "
        f"jaxsfm export {results} --to nerfstudio --out NERF"
    )


def _for_lost(lost: Sequence[LostPhoto]) -> str:
    """What may help most of the lost photos; of equal ones what was found first."""
    helped: dict[str | None, list[tuple[str, str]]] = {}
    for photo in lost:
        for advice in photo.help or ():
            helped.setdefault(advice.option, []).append((photo.image, advice.reason))
    if not helped:
        return f"{MORE_PHOTOS}, and run the same command again"
    option = max(helped, key=lambda each: len(helped[each]))
    image, reason = helped[option][0]
    whom = f"for {shown_name(image)}" + f" and {len(helped[option]) - 1} more" * (
        len(helped[option]) > 1
    )
    if option is None:
        return f"{whom}: {reason}"
    if not option.startswith("--"):  # a command, whose reason says how it is run
        return f"{whom}: {reason}"
    return f"run the same command again with {option} ({whom}: {reason})"
