"""Benchmarks of jaxsfm and of COLMAP's RootSIFT on public data with ground truth.

`strecha` makes whole reconstructions, and `daynight` follows the paper's night protocol. `wxbs` and
`homography` match pairs of images, `planes` fits planes to given points, and `warps` compares
relocalization rules. `speed` measures time.
"""
