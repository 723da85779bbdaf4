"""Benchmarks of jaxsfm and of COLMAP's RootSIFT on public data with ground truth.

`ledger` reconstructs many sets with plain defaults and judges the models. `strecha`, `ambiguous`
and `sequence` compare methods on whole reconstructions, and `daynight` follows the paper's night
protocol. `wxbs` matches hard pairs of images. `accelerator` measures photos and pairs a
second, and `driver` what one process does for many photos.
"""
