"""The colours of planes in pictures of matches, and how much of a plane they show."""

COLOURS = ("#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#42d4f4", "#f032e6", "#bfef45")
MAX_LINES = 60
"""The most lines of a plane. Every match has a dot."""
