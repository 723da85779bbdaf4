"""Converters from public VGG-16 weight files to jaxsfm's (`jaxsfm.io.weight_files`).

`read_source` reads a file of any family into its own convention (`Source`), `convert` brings it
into ours, `verify` compares the two by an independent forward pass.
"""
