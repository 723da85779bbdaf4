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


CURVE = DoubtCurve(half=0.058, power=0.87, most=0.39)
"""Fitted to the first mappings of drawn scenes of the half that chooses, 31 right ones and five
wrong ones whose photos contradict each other (docs/decisions/one-road.md). The limit lies between
them: right models have a disagreement of up to 0.029, and wrong ones of 0.042 and more."""
MAX_CONTRADICTED = CURVE.most_contradicted()
"""Groups of photos contradict each other if a larger share of the points of each one is
contradicted by the other."""
