"""The containers of the core: NamedTuples of arrays, without methods.

Axis letters are h, w for rows and columns of an image, c for channels, n for coarse (pool4) cells,
m for fine (pool3) cells, k for correspondences (capacity), p for planes and s for samples. Rows of
padding are marked by a mask, by an index of -1 or, for descriptors, by being zero; they never
match.
"""

import enum
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Int


class Pyramid(NamedTuple):
    """Feature maps, each half the size of the one before; the first has the image's size."""

    conv1_2: Float[Array, "b h w 64"]
    """Before the rectifier, as in the authors' code."""
    pool1: Float[Array, "b h2 w2 64"]
    pool2: Float[Array, "b h4 w4 128"]
    pool3: Float[Array, "b h8 w8 256"]
    pool4: Float[Array, "b h16 w16 512"]
    pool5: Float[Array, "b h32 w32 512"]


class Levels(NamedTuple):
    """The maps of a backbone that features are made of."""

    scores: tuple[Float[Array, "b _h _w"], ...]
    """The scores that keypoints are relocalized by, of stride 1, 2, 4 and so on below the fine map:
    squared norms of the cells of conv1_2, pool1 and pool2, or learned scores."""
    pool3: Float[Array, "b h8 w8 d"]
    """Fine descriptors, not normalised. Other backbones than VGG give their map of this stride,
    other pairs of layers (`jaxsfm.core.pair_shape`) their fine map."""
    pool4: Float[Array, "b h16 w16 c"]
    """Coarse descriptors, not normalised."""


class DenseFeatures(NamedTuple):
    """The features of one image: descriptors at its size, at half its size, and so on; keypoints.

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
    """The channels of joined descriptors that come from a smaller octave. They are weighted sums
    over the cells of that octave."""

    flat: Float[Array, "k c"]
    """The octave's descriptors."""
    cells: Int[Array, "n 4"]
    """The four cells of the octave around every joined cell."""
    weights: Float[Array, "n 4"]
    """Weights of the four cells; zero where the octave has no part."""


class JoinedFeatures(NamedTuple):
    """The features of one image with its octaves joined (`jaxsfm.core.octaves`).

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
    """How the last channels of `coarse` are made, octave after octave."""


class DescriptorGrid(NamedTuple):
    """Descriptors of a grid of cells; cell (row, column) is entry row * columns + column."""

    descriptors: Float[Array, "n c"]
    """Unit descriptors; rows past the grid are zero."""
    size: Int[Array, " 2"]
    """(rows, columns)."""
    parts: tuple[OctavePart, ...] = ()
    """How the last channels are made, octave after octave; may be empty."""


class Correspondences(NamedTuple):
    """Points of two images that may show the same place."""

    xy0: Float[Array, "k 2"]
    xy1: Float[Array, "k 2"]
    valid: Bool[Array, " k"]
    """Which rows are correspondences; the others are padding."""


class Thresholds(NamedTuple):
    """Settings of the verification. They are traced, so other values do not recompile a program."""

    threshold_px: Float[Array, ""] | float
    min_inliers: Int[Array, ""] | int
    confidence: Float[Array, ""] | float


class Status(enum.IntEnum):
    """The outcome of matching a pair."""

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
    """Number of minimal samples that were scored."""
    plane: Int[Array, " k"]
    """The plane of each correspondence; -1 for none."""


class PairMatches(NamedTuple):
    """The verified matches of one pair; row i is a match only where plane[i] >= 0."""

    cells: Int[Array, "k 2"]
    """The fine cells in image 0 and in image 1. No cell occurs twice among the matches."""
    plane: Int[Array, " k"]
    homographies: Float[Array, "p 3 3"]
    num_inliers: Int[Array, " p"]
    num_coarse: Int[Array, ""]
    num_tentative: Int[Array, ""]
    num_dropped: Int[Array, ""]
    """Number of correspondences that were lost because the list was full."""
    status: Int[Array, ""]


PRNGKey = jax.Array
