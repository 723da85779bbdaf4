"""The containers that flow through the core: NamedTuples of arrays, no methods that compute.

Axis letters: h w image rows and columns, c channels, n coarse (pool4) cells, m fine (pool3) cells,
k correspondences (capacity), p planes, s samples. Padded rows are marked by a mask, an index of -1
or, for descriptors, by being all zero; they never match.
"""

import enum
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Int


class Pyramid(NamedTuple):
    """Feature maps, each half the size of the one before; the first has the image's size."""

    conv1_2: Float[Array, "b h w 64"]
    """Before the rectifier, as the authors' code uses it (algorithm notes, section 1)."""
    pool1: Float[Array, "b h2 w2 64"]
    pool2: Float[Array, "b h4 w4 128"]
    pool3: Float[Array, "b h8 w8 256"]
    pool4: Float[Array, "b h16 w16 512"]
    pool5: Float[Array, "b h32 w32 512"]


class Levels(NamedTuple):
    """What features are made of: descriptors, and how strong the finer maps are."""

    scores: tuple[Float[Array, "b h w"], Float[Array, "b h2 w2"], Float[Array, "b h4 w4"]]
    """What relocalization walks by: squared norms of the cells of conv1_2, pool1 and pool2, or
    learned scores."""
    pool3: Float[Array, "b h8 w8 d"]
    """Fine descriptors, not normalised; of another backbone than VGG its map of that stride."""
    pool4: Float[Array, "b h16 w16 c"]
    """Coarse ones."""


class DenseFeatures(NamedTuple):
    """What one image brings to every pair: descriptors at its size, at half its size, ...

    Octave k has `grid >> k` cells; cell (row, col) is entry row * columns + col of its octave.
    """

    coarse: tuple[Float[Array, "_ c"], ...]
    """L2-normalised pool4 descriptors per octave; rows past its grid are zero."""
    fine: tuple[Float[Array, "_ d"], ...]
    """L2-normalised pool3 descriptors per octave; rows past its grid are zero."""
    keypoints: Float[Array, "m 2"]
    """(x, y) of every fine cell's keypoint, pixels of the working image."""
    coarse_grid: Int[Array, " 2"]
    """(rows, columns) of the first octave's pool4 grid."""
    fine_grid: Int[Array, " 2"]
    """(rows, columns) of the first octave's pool3 grid."""


class OctavePart(NamedTuple):
    """A smaller octave's channels of joined descriptors: weighted sums over its own cells."""

    flat: Float[Array, "k c"]
    """The octave's descriptors."""
    cells: Int[Array, "n 4"]
    """The four of them around every joined cell."""
    weights: Float[Array, "n 4"]
    """Zero for cells without this octave."""


class JoinedFeatures(NamedTuple):
    """What one image brings to a pair, its octaves joined (`jaxsfm.core.octaves`).

    Cell (row, col) is entry row * columns + col.
    """

    coarse: Float[Array, "n c"]
    """L2-normalised descriptors of the coarse cells; rows past the grid are zero."""
    fine: Float[Array, "m d"]
    """L2-normalised descriptors of the fine cells; rows past the grid are zero."""
    keypoints: Float[Array, "m 2"]
    """(x, y) of every fine cell's keypoint, pixels of the working image."""
    coarse_grid: Int[Array, " 2"]
    """(rows, columns) of the pool4 grid."""
    fine_grid: Int[Array, " 2"]
    """(rows, columns) of the pool3 grid."""
    coarse_parts: tuple[OctavePart, ...] = ()
    """What the last channels of `coarse` are made of, octave after octave."""


class DescriptorGrid(NamedTuple):
    """Descriptors of a grid of cells; cell (row, column) is entry row * columns + column."""

    descriptors: Float[Array, "n c"]
    """Unit descriptors; rows past the grid are zero."""
    size: Int[Array, " 2"]
    """(rows, columns)."""
    parts: tuple[OctavePart, ...] = ()
    """What the last channels are made of, octave after octave; empty if that is not known."""


class Correspondences(NamedTuple):
    """Points of two images that may show the same place."""

    xy0: Float[Array, "k 2"]
    xy1: Float[Array, "k 2"]
    valid: Bool[Array, " k"]
    """Which rows are correspondences; the others are padding."""


class Thresholds(NamedTuple):
    """Traced scalars of the verification: changing them does not recompile."""

    threshold_px: Float[Array, ""] | float
    min_inliers: Int[Array, ""] | int
    confidence: Float[Array, ""] | float


class Status(enum.IntEnum):
    """How a pair ended."""

    VERIFIED = 0
    TOO_FEW_MATCHES = 1
    NO_PLANE = 2


class Planes(NamedTuple):
    """Homographies peeled from a set of correspondences."""

    homographies: Float[Array, "p 3 3"]
    """Image 0 to image 1, pixels, Frobenius norm 1; zero where there is no plane."""
    num_inliers: Int[Array, " p"]
    """Members of each plane; 0 where there is no plane."""
    num_hypotheses: Int[Array, " p"]
    """Minimal samples that were scored."""
    plane: Int[Array, " k"]
    """The plane of each correspondence, -1 for none."""


class PairMatches(NamedTuple):
    """The verified matches of one pair; row i is a match only where plane[i] >= 0."""

    cells: Int[Array, "k 2"]
    """Fine cell in image 0 and in image 1; one-to-one among the matches."""
    plane: Int[Array, " k"]
    homographies: Float[Array, "p 3 3"]
    num_inliers: Int[Array, " p"]
    num_coarse: Int[Array, ""]
    num_tentative: Int[Array, ""]
    num_dropped: Int[Array, ""]
    """Correspondences beyond the list's capacity, lost."""
    status: Int[Array, ""]


PRNGKey = jax.Array
