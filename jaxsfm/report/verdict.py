"""The verdict on a model in words: whether its photos contradict it, and what to do then.

The summary on the screen and the page say the same sentences.
"""

from collections.abc import Sequence
from typing import NamedTuple

from jaxsfm.io.images import named, shown_name
from jaxsfm.sfm.check.model_check import (
    Alternative,
    Basis,
    Contradiction,
    ModelCheck,
    OtherPlace,
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
_DECISIVE = "neighbours overlap by more than half and something that occurs only once is in view"


class Finding(NamedTuple):
    """Something that speaks against a model."""

    text: str
    images: list[str]
    others: list[str]
    """The photos that contradict `images`, or the other photos of the pairs that give `images` a
    second place."""


class ModelVerdict(NamedTuple):
    """The verdict on one model in words. Sentences start in lower case and have no full stop."""

    colour: VerdictColour
    headline: str
    contradictions: list[Finding]
    """The one with most contradicted points first."""
    places: list[Finding]
    """Second places of photos, the one with most points that agree first."""
    alternatives: list[Finding]
    """The other model of the same photos, if one was made."""
    neighbours: list[Finding]
    """Photos that follow each other and do not agree with the model."""
    parts: list[Finding]
    """Photos that were in one model, which something spoke against, and are in several now."""
    scale: list[Finding]
    """Photos whose part of the model may have shrunk."""
    unconfirmed: str
    """That the photos do not show the points of the model; empty if they do."""
    decisive: str
    """Photos that would decide between two places or two models; empty if there is no choice."""
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
    contradictions = sorted(check.contradictions, key=lambda each: -each.contradicted)
    places = sorted(check.other_places, key=lambda each: -each.agreed)
    headline = in_words(colour)
    if colour == "amber" and check.unconfirmed:
        headline = f"{colour}: the photos do not show most points of the model"
    elif colour == "amber" and check.shrunk:
        headline = f"{colour}: a part of the model may have shrunk"
    elif colour == "amber" and places:
        count = len({place.image for place in places})
        fit = "1 photo fits" if count == 1 else f"{count} photos fit"
        headline += f"; {fit} into the model in a second place"
    return ModelVerdict(
        colour=colour,
        headline=headline + (f" ({model})" if model else ""),
        contradictions=[
            Finding(_against(each), each.images, each.others) for each in contradictions
        ],
        places=[Finding(_fits(each), [each.image], each.pairs) for each in places],
        alternatives=[_other_model(check.alternative)] if check.alternative else [],
        neighbours=[Finding(_apart(pair), pair[:1], pair[1:]) for pair in check.apart],
        parts=[_told_apart(check.told_apart)] if check.told_apart else [],
        scale=[_shrunk(check.shrunk)] if check.shrunk else [],
        unconfirmed=_UNCONFIRMED if check.unconfirmed else "",
        decisive=_decides(check, places),
        advice=_advice(check, places),
    )


def verdict_lines(verdicts: Sequence[ModelVerdict]) -> list[str]:
    """The verdicts as lines of the summary; one line if all are green, none if there are none."""
    if verdicts and all(each.colour == "green" for each in verdicts):
        models = "the models" if len(verdicts) > 1 else "the model"
        return [f"verdict          green: no photo contradicts {models}"]
    return [line for each in verdicts for line in _model_lines(each)]


def _model_lines(verdict: ModelVerdict) -> list[str]:
    lines = [f"verdict          {verdict.headline}"]
    for label, found in (
        ("contradiction    ", verdict.contradictions),
        ("second place     ", verdict.places),
        ("other model      ", verdict.alternatives),
        ("neighbours       ", verdict.neighbours),
        ("told apart       ", verdict.parts),
        ("scale            ", verdict.scale),
    ):
        lines += [label + each.text for each in found[:MAX_FINDINGS]]
        if more := len(found[MAX_FINDINGS:]):
            lines.append(f"{label}{more} more {'is' if more == 1 else 'are'} in report.json")
    if verdict.unconfirmed:
        lines.append(f"not refined      {verdict.unconfirmed}")
    if verdict.decisive:
        lines.append(f"would decide     {verdict.decisive}")
    if verdict.advice:
        lines.append(f"what next        {verdict.advice}")
    return lines


def _against(found: Contradiction) -> str:
    return (
        f"{named(found.images)} against {named(found.others)}: {found.contradicted} of "
        f"{found.tested} points that one group shows are missing in the other, which should show "
        "them"
    )


def _fits(place: OtherPlace) -> str:
    put = "the pair with {} puts" if len(place.pairs) == 1 else "the pairs with {} put"
    return (
        f"{shown_name(place.image)}, turned by {place.rotation_deg:.0f} degrees: "
        f"{put.format(named(place.pairs))} it there; seen from there, it agrees with "
        f"{place.agreed} points of the model and contradicts {place.contradicted}"
    )


def _other_model(other: Alternative) -> Finding:
    if other.whole:
        text = (
            f"alternative/0 has {other.images} photos in one model, as they were before they were "
            f"told apart; photos contradict each other at {other.contradicted} of its points"
        )
        return Finding(text, other.elsewhere, [])
    moved = "1 photo has" if len(other.elsewhere) == 1 else f"{len(other.elsewhere)} photos have"
    text = (
        f"alternative/0 is another mapping, which follows {FOLLOWS[other.basis]}: "
        f"{moved} another place there ({named(other.elsewhere)})"
    )
    if not other.elsewhere:
        text = f"alternative/0 is another mapping, which follows {FOLLOWS[other.basis]}"
    return Finding(text, other.elsewhere, [])


def _apart(pair: Sequence[str]) -> str:
    first, second = map(shown_name, pair)
    return f"{first} and {second} follow each other, but their matches do not agree with the model"


def _told_apart(groups: Sequence[list[str]]) -> Finding:
    shown = "; ".join(named(group) for group in groups[:MAX_FINDINGS])
    more = f"; and {len(groups) - MAX_FINDINGS} more" if len(groups) > MAX_FINDINGS else ""
    return Finding(
        "these photos were in one model, which something spoke against; each group is by "
        "itself now: "
        f"{shown}{more}",
        groups[0],
        [name for group in groups[1:] for name in group],
    )


def _shrunk(names: list[str]) -> Finding:
    see = "sees its" if len(names) == 1 else "see their"
    return Finding(
        f"{named(names)} {see} points a hundred times nearer than other photos do, or nearer still",
        names,
        [],
    )


def _decides(check: ModelCheck, places: Sequence[OtherPlace]) -> str:
    """Which photos would decide between two places or two models; empty if there is nothing to."""
    if places:
        way = f"from {shown_name(places[0].image)} to {named(places[0].pairs)}"
    elif check.alternative and not check.alternative.whole:
        way = f"from {named(check.alternative.elsewhere)} to the other photos"
    elif check.apart and check.verdict == "amber":
        way = f"from {shown_name(check.apart[0][0])} to {shown_name(check.apart[0][1])}"
    elif repeats(check.told_apart) and check.verdict == "amber":
        way = f"from {named(check.told_apart[0])} to {named(check.told_apart[1])}"
    else:
        return ""
    return f"photos taken on the way {way}, if {_DECISIVE}"


def _advice(check: ModelCheck, places: Sequence[OtherPlace]) -> str:
    colour, other = check.verdict, check.alternative
    if colour == "red":
        instead = "look whether alternative/0 is the right one, or " if other else ""
        return (
            f"do not use this model as it is: {instead}add photos taken on the way from one group "
            f"to the other, so that {_DECISIVE}, and run the same command again"
        )
    if colour == "amber" and check.unconfirmed:
        return (
            "do not use this model before you have looked at it; add photos that overlap more, and "
            "--intrinsics if the camera is known, and run the same command again"
        )
    if colour == "amber" and check.shrunk:
        return (
            "do not trust distances in this model; look where these photos and the others meet, "
            "add photos that show what both show, and run the same command again"
        )
    if colour == "amber" and repeats(check.told_apart):
        way = (
            " (alternative/0 is one way, which photos contradict)" if other and other.whole else ""
        )
        return (
            "look at each model by itself; each may be right, and what is missing is how they "
            f"belong together{way}; add such photos and run the same command again"
        )
    if colour == "amber":
        unsure = places[0].image if places else other.elsewhere[0] if other else check.apart[0][1]
        where = (
            "the model has it, and not where alternative/0 has it" if other else "the model has it"
        )
        return (
            f"look whether {shown_name(unsure)} stands where {where}; if you cannot tell, add such "
            "photos and run the same command again"
        )
    return ""
