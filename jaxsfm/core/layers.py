"""The pairs of layers whose maps are the coarse and the fine descriptors. This module imports
neither jax nor numpy."""

from typing import Literal

Layers = Literal["pool4/pool3", "conv4_3/conv3_3", "pool5/conv5_3"]
"""The coarse and the fine layer."""
PAPER_LAYERS: Layers = "pool4/pool3"
FINE_STRIDES: dict[Layers, int] = {"pool4/pool3": 8, "conv4_3/conv3_3": 4, "pool5/conv5_3": 16}
"""Side of a cell of the fine map, pixels. A cell of the coarse map is twice as long."""
