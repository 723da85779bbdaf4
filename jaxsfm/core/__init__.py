"""Pure JAX functions of arrays, without files, clocks, printing, OpenCV or COLMAP.

An import-linter contract checks this.
"""
