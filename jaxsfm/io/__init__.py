"""Reads and writes jaxsfm's own files: images, weights, features, matches and the work folder."""
