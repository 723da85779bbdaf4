"""Converts public files of VGG-16 weights to jaxsfm's format (`jaxsfm.io.weight_files`).

`read_source` reads a file of any family and keeps its own convention (`Source`). `write_converted`
converts it to jaxsfm's convention. `verify` compares the two by an independent forward pass.
"""
