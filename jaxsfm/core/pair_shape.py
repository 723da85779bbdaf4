"""The static settings of the pair program, and the pairs of layers whose maps are the descriptors.

This module imports neither jax nor numpy.
"""

import dataclasses
from typing import Literal

OneToOne = Literal["first", "similarity"]
Products = Literal["float32", "bfloat16", "float16"]
"""Types of the descriptors that are multiplied. Their products are summed in float32."""
ACCELERATOR_FACTORS = {"steps_at_once": 79, "fine_chunk": 8}
"""How many times as much an accelerator computes at once. The sizes in `PairShape` are those of a
CPU. An accelerator has thousands of lanes to fill, and every turn of a loop costs it the start of
several kernels. So all 10 000 samples of a plane are one turn. The factor of the windows follows
from the memory that a pair may take (`jaxsfm.matching.execution`). Neither has been measured on an
accelerator, and neither changes a result. The tile of coarse products stays as it is: a larger one
has a smaller share of margins, but leaves room for fewer pairs side by side
(docs/decisions/accelerators.md)."""
Layers = Literal["pool4/pool3", "conv4_3/conv3_3", "pool5/conv5_3"]
"""The coarse and the fine layer."""
PAPER_LAYERS: Layers = "pool4/pool3"
FINE_STRIDES: dict[Layers, int] = {"pool4/pool3": 8, "conv4_3/conv3_3": 4, "pool5/conv5_3": 16}
"""Side of a cell of the fine map, pixels. A cell of the coarse map is twice as long."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairShape:
    """The static settings of the pair program. Another value of any field is another program.

    Sizes of what is computed at once are those of a CPU (`for_accelerators`).
    """

    max_planes: int = 5
    """Largest number of homographies of a pair (paper, section 4)."""
    max_hypotheses: int = 10_000
    """Largest number of minimal samples for a plane."""
    hypotheses_per_step: int = 64
    """Number of samples of a step. After each step RANSAC looks at its stopping rule."""
    steps_at_once: int = 2
    """Number of steps whose samples are solved and scored together. Steps that the stopping rule
    then leaves out count for nothing, so other numbers give the same planes."""
    two_way: bool = False
    """Inliers are tested in both images, instead of in image 1 only."""
    local_refits: int = 1
    """Largest number of least-squares refits of each new best hypothesis to its inliers."""
    plane_rounds: int = 0
    """Number of rounds in which the planes compete for their correspondences (one-way errors)."""
    one_to_one: OneToOne = "first"
    """Which match of a cell survives: the first in index order, or the most similar one."""
    consensus: int = 0
    """Radius, coarse cells, of the neighbourhood that votes on coarse matches; 0 for no votes."""
    coarse_columns: int = 128
    """Largest number of coarse columns for which votes work, 2048 px; widened for wider images."""
    coarse_tile: int = 1024
    """Number of rows of the coarse similarity matrix that are held at once."""
    fine_chunk: int = 16
    """Number of coarse matches whose windows are compared at once."""
    compared_first: int = 1024
    """Number of correspondences on which hypotheses are compared. Only one that is better there
    than all before is tested on every correspondence. Of up to 1024 correspondences, all count. Of
    more, 26 inliers are so small a share that 10 000 samples find them once in 300 times. With 512,
    pairs of 700 to 1000 matches lose planes (docs/decisions/accelerators.md)."""
    correspondences_per_cell: float = 2.0
    """Capacity of the list of correspondences, per fine cell."""

    def __post_init__(self) -> None:
        for name in (
            "max_planes",
            "max_hypotheses",
            "hypotheses_per_step",
            "steps_at_once",
            "local_refits",
            "coarse_columns",
            "coarse_tile",
            "fine_chunk",
            "compared_first",
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

    def for_accelerators(self) -> "PairShape":
        """The same settings with more computed at once (`ACCELERATOR_FACTORS`)."""
        larger = {name: getattr(self, name) * by for name, by in ACCELERATOR_FACTORS.items()}
        return dataclasses.replace(self, **larger)
