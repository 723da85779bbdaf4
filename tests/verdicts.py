"""Checks of models with each of the verdicts, and a photo that was taken out, made up."""

import dataclasses

from jaxsfm.report.run_report import RunReport
from jaxsfm.sfm.check.check_model import Checked
from jaxsfm.sfm.check.model_check import (
    Alternative,
    Contradiction,
    ModelCheck,
    PoseAmbiguity,
    VerdictColour,
)
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt

NAMES = [f"checked{k}.jpg" for k in range(9)]

OTHER = Alternative(basis="order", images=9, elsewhere=NAMES[2:4], contradicted=0)


def check_of(colour: VerdictColour) -> ModelCheck:
    """A check with that verdict, which names all of NAMES."""
    contradiction = Contradiction(images=NAMES[:4], others=NAMES[4:], tested=400, contradicted=312)
    place = PoseAmbiguity(
        image=NAMES[0], pairs=NAMES[1:], agreed=120, contradicted=3, rotation_deg=89.6
    )
    return ModelCheck(
        groups=[NAMES[:4], NAMES[4:]] if colour == "red" else [NAMES],
        contradictions=[contradiction] if colour == "red" else [],
        pose_ambiguities=[place] if colour == "amber" else [],
    )


def with_verdicts(report: RunReport, *colours: VerdictColour | None) -> RunReport:
    """A report with its best model once for each verdict; None is a model that was not checked."""
    return dataclasses.replace(
        report,
        models=report.models[:1] * len(colours),
        checks=[colour and check_of(colour) for colour in colours],
    )


def outcome(*parts: list[str]) -> Checked:
    """A check of a model of these parts, the first of which contradicts all others."""
    against = [
        Contradiction(images=parts[0], others=part, tested=100, contradicted=50)
        for part in parts[1:]
    ]
    check = ModelCheck(groups=[*parts], contradictions=against, pose_ambiguities=[])
    return Checked(check, {}, {}, set(), set(), [*parts])


def taken_out(name: str) -> RegistrationAttempt:
    """What became of a photo that the refinement took out."""
    return RegistrationAttempt(
        name=name,
        registered=True,
        octave_px=None,
        candidates=160,
        agreed=8,
        error_px=None,
        held=3,
    )
