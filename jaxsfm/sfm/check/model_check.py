"""The outcome of the check of a model, and the verdict that follows from it."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

from jaxsfm.io.pairs import Pair

MIN_VIEWS = 3
"""A model of two photos is not checked: nothing in it can contradict the pair that it is made of.
"""
VerdictColour = Literal["green", "amber", "red"]
"""Green: nothing speaks against the model. Amber: another model may explain the photos as well.
Some fit into the model in a second place, another model was made, photos that follow each other do
not agree with the model, groups of photos contradicted each other and were split, the scale of a
part of the model has drifted, or the photos do not show enough of its points to refine it. Red:
groups of its photos contradict each other."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contradiction:
    """Two groups of photos that cannot both be where the model has them."""

    images: list[str]
    others: list[str]
    tested: int
    """Points of one group that photos of the other one should show."""
    contradicted: int
    """Those of them where these photos show something else."""

    def joined_by(self, pair: Pair) -> bool:
        """Whether a pair has one photo in either group."""
        return all(set(group) & set(pair) for group in (self.images, self.others))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseAmbiguity:
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


Basis = Literal["pairs", "order"]
"""What a model follows where pairs exclude each other: most of the pairs, or the order of the
photos' names."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alternative:
    """Another model of the same photos, which joins them in another way."""

    basis: Basis
    """What it follows."""
    images: int
    """The number of its photos."""
    elsewhere: list[str]
    """Photos that have other places in it than in the model, as seen from most photos. Sorted."""
    contradicted: int
    """Points at which its photos contradict each other."""
    whole: bool = False
    """Whether it is the model that was split, as it was before. Otherwise it follows what the
    model itself does not follow."""


def repeats(split_groups: Sequence[Sequence[str]]) -> bool:
    """Whether groups of photos that were split say that the scene repeats itself, so that it
    may do so elsewhere, too.

    Photos that agree with each other, and contradict others that agree with each other, show two
    places that were taken for one. A photo that contradicts all others was put down badly, and it
    has lost its place.
    """
    return sum(len(group) > 1 for group in split_groups) > 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelCheck:
    """What the photos of a model say of it."""

    groups: list[list[str]]
    """Photos that agree with each other, the largest group first. Groups that have nothing in
    common do not contradict each other."""
    contradictions: list[Contradiction]
    pose_ambiguities: list[PoseAmbiguity]
    """Sorted by the photo's name."""
    alternative: Alternative | None = None
    apart: list[list[str]] = dataclasses.field(default_factory=list)
    """Pairs of photos that follow each other by their names and were matched, but whose matches do
    not agree with the model. Sorted."""
    split_groups: list[list[str]] = dataclasses.field(default_factory=list)
    """Groups of photos, the largest first, that were in one model with others which they
    contradict. Each group of three photos or more is in a model without the others now. They are
    the same for all models of a run (`repeats`)."""
    scale_drift: list[str] = dataclasses.field(default_factory=list)
    """Photos that see their points so much nearer than others that the scale of a part has drifted
    (`jaxsfm.sfm.check.check_model.scale_drift`). Sorted."""
    doubt: float = 0.0
    """How probable it is that the model is wrong, from how far its photos contradict each other
    (`jaxsfm.sfm.check.grouping`). Nothing else that speaks against a model is part of it."""
    unconfirmed: bool = False
    """Whether the model was not refined, because too few of its points were found in the photos
    that should show them."""
    same_pixels: bool = False
    """Whether most of what the photos show of the model stays at the same pixels in all of them
    (`jaxsfm.sfm.check.still_model`)."""

    @property
    def verdict(self) -> VerdictColour:
        """Whether the model may be wrong."""
        if self.contradictions:
            return "red"
        speaks_against = self.apart or self.unconfirmed or self.same_pixels or self.doubted()
        return "amber" if speaks_against else "green"

    def doubted(self) -> bool:
        """Whether more speaks against the model than photos that follow each other (`apart`)."""
        elsewhere = self.pose_ambiguities, self.alternative, repeats(self.split_groups)
        return any((self.contradictions, *elsewhere, self.scale_drift))

    def photos(self) -> set[str]:
        """The photos of the model."""
        return {name for group in self.groups for name in group}
