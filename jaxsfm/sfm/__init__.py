"""From verified pairs to a refined and evaluated model."""
