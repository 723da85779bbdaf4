"""Homography RANSAC: vmapped hypotheses, compared on few matches, adaptive stop, planes in turn.

The structure is that of the authors' code: at most 10 000 samples, a confidence of 0.999, one
least-squares refit at each new best hypothesis, and up to five planes of at least 26 inliers, each
on the correspondences that the earlier ones left. The minimal solution differs: their code takes
the wrong singular vector, and here it is the true solution.

Hypotheses are compared on at most `PairShape.compared_first` correspondences. Only one that is
better there than all before is tested on every correspondence, and refitted (preemptive tests:
Chum and Matas 2002, "Randomized RANSAC with T(d,d) test", and Nister 2003, "Preemptive RANSAC").

Correspondences are compacted first, so the amount of work follows their number and not the capacity
of their list. Random numbers depend on (key, plane, step) and not on the capacity either.

Everything here may be vmapped (`jaxsfm.core.lanes`). A CPU computes the lanes of a batch in turn.
Elsewhere they take their steps together until the last one has finished. All samples of a plane are
then one turn, and the n-th new best hypotheses of all lanes are refitted at the same time. The
loops give what steps one after the other would give, however many steps are one turn; programs of
another shape only round differently.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core import homography as hg
from jaxsfm.core.lanes import in_turn_on_cpus
from jaxsfm.core.numerics import compact
from jaxsfm.core.pair_shape import PairShape
from jaxsfm.core.planes import settle
from jaxsfm.core.types import Correspondences, Planes, PRNGKey, Thresholds


class _Problem(NamedTuple):
    """Normalised correspondences, of which the first `num_live` rows count."""

    xy0: Float[Array, "k 2"]
    xy1: Float[Array, "k 2"]
    num_live: Int[Array, ""]
    threshold0: Float[Array, ""]
    threshold1: Float[Array, ""]


def sample_indices(key: PRNGKey, num: int, count: Int[Array, ""]) -> Int[Array, "num 4"]:
    """`num` uniform samples of four different indices below `count` (at least 4), in any order.

    The i-th index is drawn below count - i and then moved past the indices drawn before.
    """
    bits = jax.random.bits(key, (4, num), jnp.uint32)
    drawn: list[Array] = []
    ascending: list[Array] = []
    for i in range(4):
        most = jnp.maximum(count - i, 1).astype(jnp.uint32)
        x = lax.rem(bits[i], most).astype(jnp.int32)
        for smaller in ascending:
            x = x + (x >= smaller).astype(x.dtype)
        drawn.append(x)
        for j, other in enumerate(ascending):
            ascending[j], x = jnp.minimum(other, x), jnp.maximum(other, x)
        ascending.append(x)
    return jnp.stack(drawn, axis=1)


def hypotheses_needed(
    num_inliers: Int[Array, ""], count: Int[Array, ""], confidence: Float[Array, ""] | float
) -> Float[Array, ""]:
    """The number of samples after which one of inliers alone was drawn with probability
    `confidence`.

    A sample of inliers alone has the hypergeometric probability prod (i - k) / (n - k), k = 0..3.
    """
    k = jnp.arange(4, dtype=jnp.float32)
    i, n = num_inliers.astype(jnp.float32), count.astype(jnp.float32)
    p = jnp.prod(jnp.maximum(i - k, 0.0) / jnp.maximum(n - k, 1.0))
    # log1p is accurate for p far below the epsilon of float32. With p = 1 one sample is enough.
    miss = jnp.log1p(-jnp.minimum(p, 1.0 - 1e-6))
    wrong = jnp.log(1.0 - jnp.asarray(confidence, jnp.float32))
    return jnp.where(p > 0, wrong / jnp.where(p > 0, miss, -1.0), jnp.inf)


class _Few(NamedTuple):
    """The correspondences on which hypotheses are compared first.

    They are columns, because slices of (k, 2) would be read with a stride of two, which is four
    times as slow.
    """

    columns: tuple[Array, ...]
    """x0, y0, x1 and y1, each (m,)."""
    num_live: Int[Array, ""]


def _few(problem: _Problem, shape: PairShape) -> _Few:
    """Correspondences at even distances in the list; all of them if they are no more than that."""
    size = min(shape.compared_first, problem.xy0.shape[0])
    place = jnp.arange(size, dtype=jnp.int32)
    row = jnp.where(problem.num_live > size, place * problem.num_live // size, place)
    columns = tuple(xy[:, axis][row] for xy in (problem.xy0, problem.xy1) for axis in (0, 1))
    return _Few(columns, jnp.minimum(problem.num_live, size))


def _inliers(h: Array, problem: _Problem, shape: PairShape) -> Array:
    xy0, xy1 = problem.xy0, problem.xy1
    live = jnp.arange(xy0.shape[0], dtype=jnp.int32) < problem.num_live
    return live & hg.inliers(
        h, xy0, xy1, problem.threshold0, problem.threshold1, two_way=shape.two_way
    )


def _count(h: Array, few: _Few, problem: _Problem, shape: PairShape) -> Array:
    """The number of inliers of every hypothesis among few correspondences."""
    x0, y0, x1, y1 = few.columns
    some = problem._replace(
        xy0=jnp.stack([x0, y0], axis=1), xy1=jnp.stack([x1, y1], axis=1), num_live=few.num_live
    )
    return jnp.sum(_inliers(h, some, shape), axis=-1, dtype=jnp.int32)


def _refit(h: Array, than: Array, problem: _Problem, shape: PairShape) -> tuple[Array, Array]:
    """Least squares on the inliers, at most `local_refits` times, as long as inliers are gained.

    If h has `than` inliers or fewer, it is not refitted.

    Returns:
      the homography and its number of inliers.
    """
    inlier = _inliers(h, problem, shape)
    num = inlier.sum(dtype=jnp.int32)

    def body(state):
        i, h, num, inlier, _ = state
        candidate = hg.least_squares(problem.xy0, problem.xy1, inlier.astype(jnp.float32))
        near = _inliers(candidate, problem, shape)
        count = near.sum(dtype=jnp.int32)
        better = count > num
        return i + 1, jnp.where(better, candidate, h), jnp.maximum(count, num), near, better

    def more(state):
        return (state[0] < shape.local_refits) & state[-1]

    return lax.while_loop(more, body, (jnp.int32(0), h, num, inlier, num > than))[1:3]


class _Search(NamedTuple):
    """The best homography so far, and the number of steps that led to it."""

    steps: Int[Array, ""]
    h: Float[Array, "3 3"]
    num: Int[Array, ""]
    bar: Int[Array, ""]
    """The largest number of inliers, among the few, of a hypothesis that was looked at."""


def _one_plane(
    key: PRNGKey, problem: _Problem, thresholds: Thresholds, active: Array, shape: PairShape
) -> tuple[Array, Array, Array]:
    """The best homography (normalised), its number of inliers, and the number of hypotheses."""
    step_size, together = shape.hypotheses_per_step, shape.steps_at_once
    few, each = _few(problem, shape), jnp.arange(together, dtype=jnp.int32)

    def steps_needed(search):
        needed = hypotheses_needed(search.num, problem.num_live, thresholds.confidence)
        steps = jnp.ceil(jnp.minimum(needed, shape.max_hypotheses) / step_size)
        return jnp.where(active, steps.astype(jnp.int32), 0)

    def turn(state):
        first, search = state
        step = first + each
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(step)
        index = jax.vmap(lambda k: sample_indices(k, step_size, problem.num_live))(keys)
        h, valid = hg.from_four_points(problem.xy0[index], problem.xy1[index])
        counts = jnp.where(valid, _count(h, few, problem, shape), 0)
        best = jnp.argmax(counts, axis=1)
        h, counts = h[each, best], counts[each, best]

        def promising(search):
            late = (step >= search.steps) & (step < steps_needed(search))
            return late & (counts > search.bar)

        def look(search):
            i = jnp.argmax(promising(search))
            found, num = _refit(h[i], search.num, problem, shape)
            bar = jnp.maximum(counts[i], _count(found, few, problem, shape))
            best = jnp.where(num > search.num, found, search.h)
            return _Search(step[i] + 1, best, jnp.maximum(num, search.num), bar)

        search = lax.while_loop(lambda search: promising(search).any(), look, search)
        done = jnp.minimum(steps_needed(search), first + together)
        return first + together, search._replace(steps=jnp.maximum(search.steps, done))

    # A homography of fewer than five inliers says nothing beside its own sample.
    start = _Search(jnp.int32(0), jnp.eye(3, dtype=jnp.float32), jnp.int32(0), jnp.int32(4))
    state = (jnp.int32(0), start)
    _, search = lax.while_loop(lambda state: state[0] < steps_needed(state[1]), turn, state)
    return search.h, search.num, search.steps * step_size


def peel_planes(
    key: PRNGKey,
    xy0: Float[Array, "k 2"],
    xy1: Float[Array, "k 2"],
    valid: Bool[Array, " k"],
    thresholds: Thresholds,
    *,
    shape: PairShape,
) -> Planes:
    """Up to `max_planes` homographies, each on the correspondences that the earlier ones left.

    Peeling stops at the first homography with fewer than `min_inliers` inliers (paper, section 3.3;
    authors' code). With `plane_rounds` above 0 the planes then compete for the correspondences
    (`jaxsfm.core.planes`).

    Args:
      key: the key of the pair.
      xy0, xy1: pixels of the working images.
      valid: which rows are correspondences.
    """
    whole = in_turn_on_cpus(functools.partial(_peel, shape=shape))
    return whole(key, xy0, xy1, valid, thresholds)


def _peel(
    key: PRNGKey, xy0: Array, xy1: Array, valid: Array, thresholds: Thresholds, shape: PairShape
) -> Planes:
    k = xy0.shape[0]
    weight = valid.astype(jnp.float32)
    t0, t1 = hg.normalisation(xy0, weight), hg.normalisation(xy1, weight)
    n0, n1 = hg.apply_affine(t0, xy0), hg.apply_affine(t1, xy1)
    reach0 = jnp.asarray(thresholds.threshold_px, jnp.float32) * t0[0, 0]
    reach1 = jnp.asarray(thresholds.threshold_px, jnp.float32) * t1[0, 0]
    floor = jnp.maximum(jnp.asarray(thresholds.min_inliers, jnp.int32), 4)

    def peel(state, p):
        left, going = state
        index, count = compact(left, size=k)
        going = going & (count >= floor)
        problem = _Problem(n0[index], n1[index], count, reach0, reach1)
        h, num, used = _one_plane(jax.random.fold_in(key, p), problem, thresholds, going, shape)
        going = going & (num >= floor)
        member = going & left & hg.inliers(h, n0, n1, reach0, reach1, two_way=shape.two_way)
        return (left & ~member, going), (jnp.where(going, h, 0.0), used, member)

    planes = jnp.arange(shape.max_planes, dtype=jnp.int32)
    _, (h, used, member) = lax.scan(peel, (valid, jnp.bool_(True)), planes)
    plane = jnp.where(member.any(0), jnp.argmax(member, axis=0), -1).astype(jnp.int32)
    num = member.sum(axis=1, dtype=jnp.int32)
    if shape.plane_rounds:
        found = Correspondences(n0, n1, valid)
        h, num, plane = settle(h, num, found, reach1, floor, rounds=shape.plane_rounds)
    to_pixels = jax.vmap(lambda h: hg.orient(hg.compose(hg.adjugate(t1), hg.compose(h, t0))))
    pixels = to_pixels(h)
    return Planes(jnp.where((num > 0)[:, None, None], pixels, 0.0), num, used, plane)
