"""Moves the keypoints of a model to sub-pixel places and adjusts the model."""
