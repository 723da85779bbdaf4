"""A similarity between two sets of points of which some may be wrong, and how certain it is."""

import itertools
from typing import NamedTuple

import numpy as np
from scipy import stats

from jaxsfm.sfm.evaluation import Similarity, umeyama

LEAST = 3
"""The number of points that determine a similarity."""
REDUNDANT = 5
"""With fewer points no point is called wrong: any three of four fit well."""
MAX_TRIPLES = 300
"""If there are more triples of points, so many are drawn. If half of the points are wrong, one
triple in eight has none of them."""
IMPROVED = 10
"""The number of triples whose similarities are improved."""
CERTAIN = 0.999
"""A point is wrong if chance moves a right one as far with a probability of 0.1 %."""
EXACT = 1e-6
"""Deviations below this share of the size of the set are rounding."""


class Anchors(NamedTuple):
    """Points of a model whose positions were measured."""

    source: np.ndarray
    """float64 (n, 3): where they are in the model."""
    target: np.ndarray
    """float64 (n, 3): where they were measured, metres."""
    deviation: np.ndarray
    """float64 (n,): expected errors; only their ratios matter."""

    def select(self, rows: np.ndarray) -> "Anchors":
        """Some of the anchors (a mask or indices)."""
        return Anchors(self.source[rows], self.target[rows], self.deviation[rows])

    def fit(self) -> Similarity:
        """The similarity with the least squared error, each divided by its expected deviation."""
        return umeyama(self.source, self.target, 1 / self.deviation**2)

    def residuals(self, similarity: Similarity) -> np.ndarray:
        """float64 (n, 3): where the model has the points, minus where they were measured."""
        return similarity.moved_points(self.source) - self.target


def robust_similarity(anchors: Anchors) -> tuple[Similarity, np.ndarray]:
    """The similarity from the model to the measured positions, and bool (n,): who agrees with it.

    The sum of the smaller half of the squared errors is minimised first (least trimmed squares),
    which up to half of the points being wrong does not mislead. Points are then added as long as
    an F test takes their errors for those of right points.

    Source: Rousseeuw and Van Driessen 2006, "Computing LTS regression for large data sets".

    Args:
      anchors: at least three, not on one line.
    """
    n = len(anchors.source)
    if n < LEAST:
        raise ValueError(f"anchors must be at least {LEAST}; got {n}")
    if n < REDUNDANT:
        return anchors.fit(), np.ones(n, bool)
    half = (n + LEAST + 1) // 2

    def nearest(similarity: Similarity) -> tuple[float, np.ndarray]:
        squared = _squared(anchors, similarity)
        rows = np.sort(np.argsort(squared, kind="stable")[:half])
        return float(squared[rows].sum()), rows

    triples = [anchors.select(np.asarray(rows)) for rows in _triples(n)]
    starts = [each.fit() for each in triples if np.ptp(each.source, axis=0).any()]
    starts.sort(key=lambda start: nearest(start)[0])
    best, used = np.inf, np.arange(n)
    for start in [anchors.fit(), *starts[:IMPROVED]]:
        cost, rows = nearest(start)
        while True:  # each step lowers the cost, and there are finitely many sets of rows
            improved, next_rows = nearest(anchors.select(rows).fit())
            if not improved < cost:
                break
            cost, rows = improved, next_rows
        if cost < best:
            best, used = cost, rows
    return _grown(anchors, used)


def _squared(anchors: Anchors, similarity: Similarity) -> np.ndarray:
    """float64 (n,): squared errors in units of the expected deviation."""
    return (anchors.residuals(similarity) ** 2).sum(1) / anchors.deviation**2


def _triples(n: int) -> list[tuple[int, ...]]:
    if n * (n - 1) * (n - 2) // 6 <= MAX_TRIPLES:
        return list(itertools.combinations(range(n), LEAST))
    rng = np.random.default_rng(0)
    return [tuple(rng.choice(n, LEAST, replace=False).tolist()) for _ in range(MAX_TRIPLES)]


def _grown(anchors: Anchors, rows: np.ndarray) -> tuple[Similarity, np.ndarray]:
    """Add points that agree with the others until there are no more."""
    n = len(anchors.source)
    spread = np.linalg.norm(anchors.target - anchors.target.mean(0), axis=1).max()
    floor = (EXACT * spread / anchors.deviation.min()) ** 2
    used = np.zeros(n, bool)
    used[rows] = True
    while True:
        part = anchors.select(used)
        similarity = part.fit()
        squared = _squared(anchors, similarity)
        freedom = 3 * int(used.sum()) - 7
        variance = max(float(squared[used].sum()) / freedom, floor)
        # The error of a point that took no part contains that of the similarity at its place.
        jacobian = _jacobian(similarity, part, anchors)
        within = _jacobian(similarity, part, part) / part.deviation[:, None, None]
        spread_of = np.linalg.pinv(np.einsum("nij,nik->jk", within, within))
        own = np.einsum("nij,jk,nik->n", jacobian, spread_of, jacobian) / 3
        scaled = squared / (3 * variance * (1 + own / anchors.deviation**2))
        added = ~used & (scaled < stats.f.ppf(CERTAIN, 3, freedom))
        if not added.any():
            return similarity, used
        used |= added


def _jacobian(similarity: Similarity, middle: Anchors, anchors: Anchors) -> np.ndarray:
    """float64 (n, 3, 7): how moved points change with the similarity.

    The seven columns are a shift, a turn about the middle (radians), and a relative scale.
    """
    weights = 1 / middle.deviation**2
    centre = weights @ similarity.moved_points(middle.source) / weights.sum()
    arm = similarity.moved_points(anchors.source) - centre
    n = len(arm)
    made = np.zeros((n, 3, 7))
    made[:, :, :3] = np.eye(3)
    for axis in range(3):
        made[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
    made[:, :, 6] = arm
    return made


class Certainty(NamedTuple):
    """Expected deviations (one sigma) of a similarity, if errors of the anchors are independent."""

    shift: np.ndarray
    """float64 (3,): of the middle of the anchors, metres."""
    turn_deg: float
    """About the axis that is the least certain, degrees."""
    scale: float
    """Of the scale, as a share of it."""


def certainty(anchors: Anchors, similarity: Similarity) -> Certainty:
    """How certain a similarity is that was fitted to anchors, from their own residuals.

    Horizontal and vertical errors may differ: their variances are estimated apart if there are
    `REDUNDANT` anchors or more.
    """
    n = len(anchors.source)
    relative = anchors.residuals(similarity) / anchors.deviation[:, None]
    # A turn about the vertical, the scale and a shift take up four of the horizontal errors; two
    # tilts and a shift take up three of the vertical ones.
    parts = (relative[:, :2] ** 2).sum(), (relative[:, 2] ** 2).sum()
    if n >= REDUNDANT:
        flat, up = parts[0] / (2 * n - 4), parts[1] / (n - 3)
    else:
        flat = up = sum(parts) / (3 * n - 7)
    jacobian = _jacobian(similarity, anchors, anchors) / anchors.deviation[:, None, None]
    inverse = np.linalg.pinv(np.einsum("nij,nik->jk", jacobian, jacobian))
    spread = np.einsum("nij,i,nik->jk", jacobian, np.asarray([flat, flat, up]), jacobian)
    covariance = inverse @ spread @ inverse
    turn = np.linalg.eigvalsh(covariance[3:6, 3:6])[-1]
    return Certainty(
        shift=np.sqrt(np.diag(covariance)[:3]),
        turn_deg=float(np.degrees(np.sqrt(max(turn, 0.0)))),
        scale=float(np.sqrt(covariance[6, 6])),
    )
