"""The outcome of the check of a model, and the verdict that follows from it."""

import dataclasses
from typing import Literal

MIN_VIEWS = 3
"""A model of two photos is not checked: nothing in it can contradict the pair that it is made of.
"""
VerdictColour = Literal["green", "amber", "red"]
"""Green: nothing speaks against the model. Amber: photos fit into it in a second place, so another
model explains them as well. Red: groups of its photos contradict each other."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Two groups of photos that cannot both be where the model has them."""

    images: list[str]
    others: list[str]
    tested: int
    """Points of one group that photos of the other one should show."""
    contradicted: int
    """Those of them where these photos show something else."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OtherPlace:
    """A second place of a photo in the model, which pairs give that the model does not agree with.

    Nothing in the photo speaks against this place.
    """

    image: str
    pairs: list[str]
    """The other photos of these pairs."""
    agreed: int
    """Points of the model that the photo shows, seen from there: a mean over the other photos that
    see them."""
    contradicted: int
    """Points of the model instead of which it shows something else, seen from there; likewise."""
    rotation_deg: float
    """How far the photo is turned there against its place in the model."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelCheck:
    """What the photos of a model say of it."""

    groups: list[list[str]]
    """Photos that agree with each other, the largest group first. Groups that have nothing in
    common do not contradict each other."""
    contradictions: list[Contradiction]
    other_places: list[OtherPlace]
    """Sorted by the photo's name."""

    @property
    def verdict(self) -> VerdictColour:
        """Whether the model may be wrong."""
        if self.contradictions:
            return "red"
        return "amber" if self.other_places else "green"
