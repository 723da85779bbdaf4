"""Chooses frames of a video, and reconstructs them."""
