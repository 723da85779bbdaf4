"""The verdict at the top of the page: what came of the run, in a few lines and numbers."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

from jaxsfm.report.page.figures import count, figures3
from jaxsfm.report.run_report import RunReport
from jaxsfm.report.run_results import EvaluationReport, ModelRow


class Fact(NamedTuple):
    """A number with its name."""

    label: str
    value: str
    note: str = ""


class Verdict(NamedTuple):
    """What came of the run."""

    level: Literal["good", "partial", "none"]
    headline: str
    sentences: list[str]
    facts: list[Fact]


def duration(seconds: float) -> str:
    """A time in its two largest units."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def verdict(report: RunReport) -> Verdict:
    """What came of the run."""
    usable = report.images.usable
    time = Fact("time", duration(sum(report.seconds.values())), "all stages of the last call")
    if not report.models:
        reason = report.no_model or ""
        return Verdict(
            "none",
            "No model could be built.",
            [
                f"{reason[0].upper()}{reason[1:]}." if reason else "",
                "The sections below say what became of each photo and of each pair of photos.",
            ],
            [Fact("photos in the model", f"0 of {usable}"), time],
        )
    best, others = report.models[0], len(report.models) - 1
    whole = best.registered == usable
    headline = (
        f"All {usable} photos are in one model."
        if whole
        else f"{best.registered} of {usable} photos are in one model; "
        f"{usable - best.registered} are lost."
    )
    sentences = [*_sentences(report, best)]
    if others and not whole:
        sentences.append(f"{others} smaller model{'s' * (others > 1)} could not be joined to it.")
    facts = [
        Fact("photos in the model", f"{best.registered} of {usable}"),
        Fact("reprojection error", f"{best.reprojection_error_px:.2f} px", "mean"),
        Fact("3-D points", count(best.points), f"each in {best.track_length:.1f} photos (mean)"),
        *_error_facts(report.evaluation),
        time,
    ]
    return Verdict("good" if whole else "partial", headline, sentences, facts)


def _sentences(report: RunReport, best: ModelRow) -> Iterable[str]:
    yield (
        "On average, the model projects a point "
        f"{best.reprojection_error_px:.2f} px away from the place where it was seen in a photo. A "
        "good model has a small value, but a small value alone does not prove that a model is good."
    )
    if report.evaluation:
        position, rotation = report.evaluation.position, report.evaluation.rotation_deg
        mean, most = (
            f"{figures3(p)} units and {figures3(r)} deg"
            for p, r in ((position.mean, rotation.mean), (position.max, rotation.max))
        )
        yield (
            f"Against the reference the cameras are off by {mean} on average, and by {most} at "
            "most."
        )
    else:
        yield report.evaluation_failed or (
            "There are no reference poses to compare with. To judge the model, look at its 3-D "
            "view and at the refused pairs."
        )


def _error_facts(evaluation: EvaluationReport | None) -> Iterable[Fact]:
    if evaluation:
        position, rotation = evaluation.position.mean, evaluation.rotation_deg.mean
        yield Fact("position error", figures3(position), "mean, units of the reference")
        yield Fact("rotation error", f"{figures3(rotation)}\u00b0", "mean")
