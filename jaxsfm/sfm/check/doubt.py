"""How probable it is that a model is wrong, from how far its photos contradict each other.

The photos of a model are joined to groups, those first that agree most surely, until all are one
group. The largest share of contradicted points at which two groups were joined is the
*disagreement* of the model. Right models of ordinary photos have next to none, and models that take
two places for one have much. A curve fitted to drawn models with known cameras turns the
disagreement into a probability, and the verdict doubts a model above one limit of it.
docs/decisions/one-road.md has the error rates over the limit.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class DoubtCurve:
    """The probability that a model is wrong, over its disagreement, and when it is doubted."""

    half: float
    """The disagreement of a model that is as probably wrong as right."""
    power: float
    """The odds grow with this power of the disagreement."""
    most: float
    """A model is doubted if it is wrong with a larger probability."""

    def probability(self, disagreement: float) -> float:
        """The probability that a model with this disagreement is wrong."""
        if disagreement <= 0:
            return 0.0
        return 1 / (1 + (self.half / disagreement) ** self.power)

    def most_contradicted(self) -> float:
        """The disagreement above which a model is doubted."""
        return self.half * (self.most / (1 - self.most)) ** (1 / self.power)


CURVE = DoubtCurve(half=0.055, power=1.44, most=0.54)
"""Fitted to first mappings: 31 right ones and five wrong ones of drawn scenes of the half that
chooses, 107 right ones and three wrong ones of photos (docs/decisions/one-road.md). The right ones
have a disagreement of up to 0.053 (*brighton_gps*, seen from the air), and the wrong ones of photos
of 0.069 and more. The limit lies in the middle. Three wrong ones of drawn scenes are below it."""
MAX_CONTRADICTED = CURVE.most_contradicted()
"""Groups of photos contradict each other if a larger share of the points of each one is
contradicted by the other."""
