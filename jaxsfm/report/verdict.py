"""The verdict on a model in words: whether its photos contradict it, and what to do then.

The summary on the screen and the page say the same sentences.
"""

from collections.abc import Sequence
from typing import NamedTuple

from jaxsfm.io.entries import STILL
from jaxsfm.io.images import named, shown_name
from jaxsfm.sfm.check.model_check import (
    Alternative,
    Basis,
    Contradiction,
    ModelCheck,
    PoseAmbiguity,
    VerdictColour,
    repeats,
)

MAX_FINDINGS = 3
"""The number of findings of each kind that the summary lists for each model."""
MEANING: dict[VerdictColour, str] = {
    "green": "no photo contradicts the model",
    "amber": "two models may explain these photos",
    "red": "photos contradict each other",
}
FOLLOWS: dict[Basis, str] = {
    "pairs": "most of the pairs",
    "order": "the order of the photos' names",
}
_UNCONFIRMED = (
    "too few of its points were found in the photos that should show them, so the model is as the "
    "mapper made it"
)
_STILL = (
    "more than half of what holds this model shows at the same pixels in all photos, which nothing "
    "does that a moving camera passes"
)
_OVERLAP = (
    "so that neighbours overlap by more than half and something that occurs only once is in view"
)
_AGAIN = "and run the same command again"


class Finding(NamedTuple):
    """Something that speaks against a model."""

    text: str
    images: Sequence[str] = ()
    others: Sequence[str] = ()
    """The photos that contradict `images`, or the other photos of the pairs that give `images` a
    second place."""


class Reason(NamedTuple):
    """All findings of one kind."""

    label: str
    """A word or two for the kind."""
    findings: list[Finding]
    """The weightiest first."""


class ModelVerdict(NamedTuple):
    """The verdict on one model in words. Sentences start in lower case and have no full stop."""

    colour: VerdictColour
    headline: str
    reasons: list[Reason]
    """What speaks against the model."""
    advice: str
    """What to do next; empty for a model that nothing speaks against."""


def in_words(colour: VerdictColour) -> str:
    """A verdict and what it means."""
    return f"{colour}: {MEANING[colour]}"


def model_verdicts(checks: Sequence[tuple[int, ModelCheck]]) -> list[ModelVerdict]:
    """The verdicts on several models in words.

    Args:
      checks: of each model that was checked, the number N of its folder `sparse/N`, and its check.
        If model 0 alone was checked, the words do not name the folder.
    """
    alone = [number for number, _ in checks] == [0]
    return [model_verdict(check, "" if alone else f"sparse/{n}") for n, check in checks]


def model_verdict(check: ModelCheck, model: str = "") -> ModelVerdict:
    """The verdict on one model in words.

    Args:
      model: the folder of the model, if the words should name it.
    """
    colour = check.verdict
    places = sorted(check.pose_ambiguities, key=lambda each: -each.agreed)
    headline = in_words(colour)
    if colour == "amber" and check.unconfirmed:
        headline = f"{colour}: the photos do not show most points of the model"
    elif colour == "amber" and check.same_pixels:
        headline = f"{colour}: most of the model stays at the same pixels in all photos"
    elif colour == "amber" and check.scale_drift:
        headline = f"{colour}: the scale of a part of the model may have drifted"
    elif colour == "amber" and places:
        count = len({place.image for place in places})
        fit = "1 photo fits" if count == 1 else f"{count} photos fit"
        headline += f"; {fit} into the model in a second place"
    return ModelVerdict(
        colour=colour,
        headline=headline + (f" ({model})" if model else ""),
        reasons=_reasons(check, places),
        advice=_advice(check, places),
    )


def _reasons(check: ModelCheck, places: Sequence[PoseAmbiguity]) -> list[Reason]:
    contradictions = sorted(check.contradictions, key=lambda each: -each.contradicted)
    reasons = [
        Reason("contradiction", [_against(each) for each in contradictions]),
        Reason("second place", [_fits(place) for place in places]),
        Reason("other model", [_other_model(check.alternative)] if check.alternative else []),
        Reason("neighbours", [_apart(pair) for pair in check.apart]),
        Reason("split", [_split_groups(check.split_groups)] if check.split_groups else []),
        Reason("scale", [_scale_drift(check.scale_drift)] if check.scale_drift else []),
        Reason("same pixels", [Finding(_STILL)] if check.same_pixels else []),
        Reason("not refined", [Finding(_UNCONFIRMED)] if check.unconfirmed else []),
    ]
    return [reason for reason in reasons if reason.findings]


def verdict_lines(verdicts: Sequence[ModelVerdict]) -> list[str]:
    """The verdicts as lines of the summary; one line if all are green, none if there are none.

    What to do next is not among them: it ends the run's output (`jaxsfm.report.closing`).
    """
    if verdicts and all(each.colour == "green" for each in verdicts):
        models = "the models" if len(verdicts) > 1 else "the model"
        return [f"verdict          green: no photo contradicts {models}"]
    return [line for each in verdicts for line in _model_lines(each)]


def _model_lines(verdict: ModelVerdict) -> list[str]:
    lines = [f"verdict          {verdict.headline}"]
    for label, findings in verdict.reasons:
        lines += [f"{label:<17}{each.text}" for each in findings[:MAX_FINDINGS]]
        if more := len(findings[MAX_FINDINGS:]):
            lines.append(f"{label:<17}{more} more {'is' if more == 1 else 'are'} in report.json")
    return lines


def _against(found: Contradiction) -> Finding:
    text = (
        f"{named(found.images)} against {named(found.others)}: {found.contradicted} of "
        f"{found.tested} points that one group shows are missing in the other, which should show "
        "them"
    )
    return Finding(text, found.images, found.others)


def _fits(place: PoseAmbiguity) -> Finding:
    put = "the pair with {} puts" if len(place.pairs) == 1 else "the pairs with {} put"
    text = (
        f"{shown_name(place.image)}, turned by {place.rotation_deg:.0f} degrees: "
        f"{put.format(named(place.pairs))} it there; seen from there, it agrees with "
        f"{place.agreed} points of the model and contradicts {place.contradicted}"
    )
    return Finding(text, [place.image], place.pairs)


def _other_model(other: Alternative) -> Finding:
    if other.whole:
        text = (
            f"alternative/0 has {other.images} photos in one model, as it was before it was "
            f"split; photos contradict each other at {other.contradicted} of its points"
        )
        return Finding(text, other.elsewhere)
    text = f"alternative/0 is another mapping, which follows {FOLLOWS[other.basis]}"
    if other.elsewhere:
        count = len(other.elsewhere)
        moved = "1 photo has" if count == 1 else f"{count} photos have"
        text += f": {moved} another place there ({named(other.elsewhere)})"
    return Finding(text, other.elsewhere)


def _apart(pair: Sequence[str]) -> Finding:
    first, second = map(shown_name, pair)
    text = f"{first} and {second} follow each other, but their matches do not agree with the model"
    return Finding(text, pair[:1], pair[1:])


def _split_groups(groups: Sequence[list[str]]) -> Finding:
    shown = "; ".join(named(group) for group in groups[:MAX_FINDINGS])
    more = f"; and {len(groups) - MAX_FINDINGS} more" if len(groups) > MAX_FINDINGS else ""
    return Finding(
        "these photos were in one model, which something spoke against; each group is by "
        f"itself now: {shown}{more}",
        groups[0],
        [name for group in groups[1:] for name in group],
    )


def _scale_drift(names: list[str]) -> Finding:
    see = "sees its" if len(names) == 1 else "see their"
    return Finding(
        f"{named(names)} {see} points a hundred times nearer than other photos do, or nearer still",
        names,
    )


def _advice(check: ModelCheck, places: Sequence[PoseAmbiguity]) -> str:
    """What to do next, in one sentence; empty for a model that nothing speaks against."""
    colour, other = check.verdict, check.alternative
    if colour == "red":
        instead = "look whether alternative/0 is the right one, or " if other else ""
        way = _photos_on_the_way("one group", "the other")
        return f"do not use this model as it is: {instead}{way}"
    if colour == "green":
        return ""
    if check.unconfirmed:
        return (
            "do not use this model before you have looked at it; add photos that overlap more, and "
            f"--intrinsics if the camera is known, {_AGAIN}"
        )
    if check.same_pixels:
        return f"mask what stays: look at {STILL}, add --masks with this file, {_AGAIN}"
    if check.scale_drift:
        return (
            "do not trust distances in this model; look where these photos and the others meet, "
            f"add photos that show what both show, {_AGAIN}"
        )
    if repeats(check.split_groups):
        one_way = (
            " (alternative/0 is one way, which photos contradict)" if other and other.whole else ""
        )
        way = _photos_on_the_way(*map(named, check.split_groups[:2]))
        return (
            "look at each model by itself; each may be right, and what is missing is how they "
            f"belong together{one_way}; {way}"
        )
    if places:
        unsure = start = shown_name(places[0].image)
        end = named(places[0].pairs)
    elif other and other.elsewhere:
        unsure = shown_name(other.elsewhere[0])
        start, end = named(other.elsewhere), "the other photos"
    elif check.apart:
        start, end = map(shown_name, check.apart[0])
        unsure = end
    else:
        return "look at alternative/0, too, and use the model that is right"
    where = "the model has it, and not where alternative/0 has it" if other else "the model has it"
    return (
        f"look whether {unsure} stands where {where}; if you cannot tell, "
        f"{_photos_on_the_way(start, end)}"
    )


def _photos_on_the_way(start: str, end: str) -> str:
    return f"add photos taken on the way from {start} to {end}, {_OVERLAP}, {_AGAIN}"
