"""Benchmarks on public data sets, beside COLMAP's RootSIFT.

`strecha`: whole reconstructions; `daynight`: the paper's night protocol. `wxbs`, `homography`:
pairs of images. `planes`: given points.
"""
