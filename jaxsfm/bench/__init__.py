"""Benchmarks on public data sets, beside COLMAP's RootSIFT.

`strecha`: whole reconstructions. `wxbs`, `homography`: pairs of images. `planes`: given points.
"""
