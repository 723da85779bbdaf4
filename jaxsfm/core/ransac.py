"""Homography RANSAC: vmapped hypotheses, chunked scoring, adaptive stop, planes peeled in turn.

The structure is that of the authors' code: at most 10 000 samples, a confidence of 0.999, one
least-squares refit at each new best hypothesis, and up to five planes of at least 26 inliers, each
on the correspondences that the earlier ones left. The minimal solution differs: their code takes
the wrong singular vector, and here it is the true solution.

Correspondences are compacted first, so the amount of work follows their number and not the capacity
of their list. Random numbers depend on (key, plane, step) and not on the capacity either.

Everything here may be vmapped (`jaxsfm.core.lanes`). A CPU computes the lanes of a batch in turn.
Elsewhere they take their steps together until the last one has finished. A lane that has finished
is left as it is, and refits run in those steps only in which a lane has found a better hypothesis.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsfm.core import homography as hg
from jaxsfm.core.lanes import anywhere, in_turn_on_cpus
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
    drawn: list[Array] = []
    for i in range(4):
        most = jnp.maximum(count - i, 1)
        x = jax.random.randint(jax.random.fold_in(key, i), (num,), 0, most, jnp.int32)
        earlier = jnp.sort(jnp.stack(drawn, axis=1), axis=1) if drawn else None
        for j in range(i):
            assert earlier is not None
            x = x + (x >= earlier[:, j]).astype(x.dtype)
        drawn.append(x)
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


def _inliers(h: Array, problem: _Problem, shape: PairShape) -> Array:
    xy0, xy1 = problem.xy0, problem.xy1
    live = jnp.arange(xy0.shape[0], dtype=jnp.int32) < problem.num_live
    return live & hg.inliers(
        h, xy0, xy1, problem.threshold0, problem.threshold1, two_way=shape.two_way
    )


def count_inliers(
    h: Float[Array, "s 3 3"], problem: _Problem, *, shape: PairShape
) -> Int[Array, " s"]:
    """The number of inliers of every hypothesis, computed a chunk of correspondences at a time.

    Coordinates are separated into columns first. Slices of (k, 2) would be read with a stride of
    two, which is four times as slow.
    """
    k = problem.xy0.shape[0]
    chunk = min(shape.score_chunk, k)
    columns = [xy[:, axis] for xy in (problem.xy0, problem.xy1) for axis in (0, 1)]

    def body(state):
        i, counts = state
        start = jnp.minimum(i * chunk, k - chunk)
        x0, y0, x1, y1 = (lax.dynamic_slice_in_dim(c, start, chunk) for c in columns)
        xy0, xy1 = jnp.stack([x0, y0], axis=1), jnp.stack([x1, y1], axis=1)
        index = start + jnp.arange(chunk, dtype=jnp.int32)
        # The last chunk is moved back to fit. Count only rows that no earlier chunk has counted.
        live = (index >= i * chunk) & (index < problem.num_live)
        hit = hg.inliers(h, xy0, xy1, problem.threshold0, problem.threshold1, two_way=shape.two_way)
        return i + 1, counts + jnp.sum(hit & live, axis=1, dtype=jnp.int32)

    start = (jnp.int32(0), jnp.zeros((h.shape[0],), jnp.int32))
    return lax.while_loop(lambda s: s[0] * chunk < problem.num_live, body, start)[1]


def _refit(
    h: Array, num: Array, problem: _Problem, shape: PairShape, *, wanted: Array | bool = True
) -> tuple[Array, Array]:
    """Least squares on the inliers, at most `local_refits` times, as long as inliers are gained.

    Where it is not `wanted`, h and num stay as they are.
    """

    def body(state):
        i, h, num, _ = state
        weight = _inliers(h, problem, shape).astype(jnp.float32)
        candidate = hg.least_squares(problem.xy0, problem.xy1, weight)
        count = _inliers(candidate, problem, shape).sum(dtype=jnp.int32)
        better = count > num
        return i + 1, jnp.where(better, candidate, h), jnp.maximum(count, num), better

    def more(state):
        return (state[0] < shape.local_refits) & state[3]

    _, h, num, _ = lax.while_loop(more, body, (jnp.int32(0), h, num, jnp.asarray(wanted)))
    return h, num


class _Search(NamedTuple):
    """The best homography so far, and the number of steps that led to it."""

    steps: Int[Array, ""]
    h: Float[Array, "3 3"]
    num: Int[Array, ""]


def _one_plane(
    key: PRNGKey, problem: _Problem, thresholds: Thresholds, active: Array, shape: PairShape
) -> tuple[Array, Array, Array]:
    """The best homography (normalised), its number of inliers, and the number of hypotheses."""
    step_size, together = shape.hypotheses_per_step, shape.steps_at_once

    def more(search):
        used = (search.steps * step_size).astype(jnp.float32)
        needed = hypotheses_needed(search.num, problem.num_live, thresholds.confidence)
        return active & (used < jnp.minimum(needed, shape.max_hypotheses))

    def look(search, found):
        h, num = found
        going = more(search)
        better = going & (num > jnp.maximum(search.num, 4))
        h, num = jnp.where(better, h, search.h), jnp.where(better, num, search.num)
        h, num = lax.cond(
            anywhere(better),
            lambda: _refit(h, num, problem, shape, wanted=better),
            lambda: (h, num),
        )
        return _Search(search.steps + going.astype(jnp.int32), h, num), None

    def body(state):
        first, search = state
        keys = jax.vmap(lambda i: jax.random.fold_in(key, first + i))(
            jnp.arange(together, dtype=jnp.int32)
        )
        index = jax.vmap(lambda k: sample_indices(k, step_size, problem.num_live))(keys)
        h, valid = hg.from_four_points(problem.xy0[index], problem.xy1[index])
        scored = problem._replace(num_live=jnp.where(more(search), problem.num_live, 0))
        counts = count_inliers(h.reshape(-1, 3, 3), scored, shape=shape).reshape(valid.shape)
        counts = jnp.where(valid, counts, 0)
        best, each = jnp.argmax(counts, axis=1), jnp.arange(together, dtype=jnp.int32)
        search, _ = lax.scan(look, search, (h[each, best], counts[each, best]))
        return first + together, search

    start = _Search(jnp.int32(0), jnp.eye(3, dtype=jnp.float32), jnp.int32(0))
    state = (jnp.int32(0), start)
    _, search = lax.while_loop(lambda state: more(state[1]), body, state)
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
