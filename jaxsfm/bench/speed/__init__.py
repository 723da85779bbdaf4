"""Measurements of speed, and of accuracy with it: `python -m jaxsfm.bench.speed`."""
