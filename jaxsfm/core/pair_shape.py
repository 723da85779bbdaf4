"""The static half of the pair program's settings. Imports neither jax nor numpy."""

import dataclasses
from typing import Literal

OneToOne = Literal["first", "similarity"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairShape:
    """Static part of the pair program; changing any field recompiles it."""

    max_planes: int = 5
    """Homographies peeled from one pair (paper, section 4)."""
    max_hypotheses: int = 10_000
    """Upper bound of minimal samples per plane."""
    hypotheses_per_step: int = 64
    """Samples solved and scored together before the stopping rule is looked at."""
    two_way: bool = False
    """Inlier test in both images instead of image 1 only."""
    local_refits: int = 1
    """Least-squares refits on the inliers of each new best hypothesis."""
    plane_rounds: int = 0
    """Rounds in which the peeled planes compete for their correspondences (one-way errors)."""
    one_to_one: OneToOne = "first"
    """Which of a cell's several matches survives: the first in index order, or the most similar."""
    consensus: int = 0
    """Radius, coarse cells, of the neighbourhood that votes on coarse matches; 0: none."""
    coarse_columns: int = 128
    """Widest coarse grid the votes reach across: 2048 px; widened for wider images."""
    coarse_tile: int = 1024
    """Rows of the coarse similarity matrix held at once."""
    fine_chunk: int = 16
    """Coarse matches whose windows are compared at once."""
    score_chunk: int = 2048
    """Correspondences scored at once: small enough to stay in cache."""
    correspondences_per_cell: float = 2.0
    """Capacity of the correspondence list, per fine cell."""

    def __post_init__(self) -> None:
        for name in (
            "max_planes",
            "max_hypotheses",
            "hypotheses_per_step",
            "local_refits",
            "coarse_columns",
            "coarse_tile",
            "fine_chunk",
            "score_chunk",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"PairShape.{name} must be at least 1; got {getattr(self, name)}")
        for name in ("consensus", "plane_rounds"):
            if getattr(self, name) < 0:
                raise ValueError(f"PairShape.{name} must be at least 0; got {getattr(self, name)}")
        if self.correspondences_per_cell <= 0:
            raise ValueError(
                "PairShape.correspondences_per_cell must be positive; "
                f"got {self.correspondences_per_cell}"
            )
