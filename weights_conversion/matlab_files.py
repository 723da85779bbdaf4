"""Reads MatConvNet's VGG-16 (Caffe's weights) and NetVLAD from MATLAB files of version 5.

The variable `layers` is a cell of structs; NetVLAD has it in the struct `net`. A convolution has
the fields `name` and `weights` = {filters, biases}, or in older files `filters` and `biases`.
Filters are H x W x I x O and are applied as correlations. The importer from Caffe has changed their
input from BGR to RGB and transposed rows and columns. The mean of the images (RGB, 0 .. 255) is
`meta.normalization.averageImage`, in older files `normalization.averageImage`.

Source: matlab/simplenn/vl_simplenn_tidy.m and utils/import-caffe.py of MatConvNet; layerVLAD.m,
addPCA.m and computeRepresentation.m of NetVLAD.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxsfm.core.vgg import LAYERS, Preprocessing
from jaxsfm.errors import UserError
from jaxsfm.io.weight_files import EXTRAS
from jaxsfm.weights_conversion.mat5 import Value, read_variables
from jaxsfm.weights_conversion.source import Convention, Source, check_layers

CONVENTION = Convention(layout="HWIO", bgr=False, convolution=False)
VARIABLES = ["layers", "meta", "normalization", "net"]
EXPORT = (
    "its VLAD layer is a MATLAB object, which only MATLAB can read; the thirteen convolutions are "
    "converted without NetVLAD's head, and weights_conversion/README.md says how to export it"
)


def _fields(value: Value) -> dict[str, Value]:
    """Return the fields of a struct, or of the one struct in a cell; {} for anything else."""
    while isinstance(value, list) and len(value) == 1:
        (value,) = value
    return value if isinstance(value, dict) else {}


def _weights(layer: dict[str, Value]) -> list[Value]:
    if "weights" in layer:
        weights = layer["weights"]
        return weights if isinstance(weights, list) else []
    return [layer.get("filters"), layer.get("biases")]


def _vector(array: Value) -> Value:
    """Flatten biases, which are stored as a row or a column."""
    return np.ravel(array) if isinstance(array, np.ndarray) else array


def _kernel(array: Value) -> Value:
    """Restore the trailing dimensions of size one, which MATLAB drops."""
    if isinstance(array, np.ndarray) and array.ndim < 4:
        return array.reshape(array.shape + (1,) * (4 - array.ndim))
    return array


def _mean(top: dict[str, Value], path: Path) -> tuple[tuple[float, float, float], tuple[str, ...]]:
    """Return the mean colour, and a note if the file's mean image has several colours."""
    holder = _fields(top.get("meta")) or top
    image = _fields(holder.get("normalization")).get("averageImage")
    if not isinstance(image, np.ndarray) or image.dtype.kind not in "fiu" or image.size < 3:
        raise UserError(f"{path}: meta.normalization.averageImage, the mean colour, is missing")
    if image.size != 3 and (image.ndim != 3 or image.shape[2] != 3):
        raise UserError(f"{path}: averageImage must have three channels; got {image.shape}")
    colours = image.reshape(-1, 3).astype(np.float64)
    red, green, blue = (float(v) for v in colours.mean(axis=0))
    if not np.isfinite(colours).all():
        raise UserError(f"{path}: averageImage has values that are not finite")
    varies = np.ptp(colours, axis=0).max() > 1e-3
    note = ("its mean image has several colours, so the mean over its pixels is taken",)
    return (red, green, blue), note * bool(varies)


def _head(layers: list[dict[str, Value]]) -> dict[str, np.ndarray]:
    """Find NetVLAD's assignment and centres, D x K, and its whitening; {} if there are none."""
    found: dict[str, np.ndarray] = {}
    for layer in layers:
        arrays = [np.squeeze(each) for each in _weights(layer) if isinstance(each, np.ndarray)]
        shapes = [each.shape for each in arrays]
        if shapes == [EXTRAS["netvlad.assignment"]] * 2:
            # MATLAB's layer adds its second array, so that array is the negative of the centres.
            found |= {"netvlad.assignment": arrays[0], "netvlad.centres": -arrays[1]}
        elif shapes == [EXTRAS["netvlad.whitening"], EXTRAS["netvlad.whitening_bias"]]:
            found |= {"netvlad.whitening": arrays[0], "netvlad.whitening_bias": arrays[1]}
    return found


def read_matlab(
    path: Path, *, sha256: str, shapes: Mapping[str, tuple[int, int]] = LAYERS
) -> Source:
    """Read imagenet-vgg-verydeep-16.mat, or a NetVLAD network with its head.

    Args:
      path: the file.
      sha256: its hash.
      shapes: input and output channels of each layer.

    Raises:
      UserError: the file is damaged, of version 7.3, or not a VGG-16.
    """
    try:
        top = read_variables(path, VARIABLES)
    except Exception as error:  # a damaged file can raise almost anything
        raise UserError(f"{path}: not a readable MATLAB file ({error})") from error
    if "net" in top:
        top = _fields(top["net"])
    cell = top.get("layers")
    if not isinstance(cell, list):
        raise UserError(f"{path}: not a network of MatConvNet, which has a cell of layers")
    layers = [_fields(each) for each in cell]
    pairs = {}
    for layer in layers:
        name = layer.get("name")
        if isinstance(name, str) and name in shapes and len(arrays := _weights(layer)) >= 2:
            pairs[name] = (_kernel(arrays[0]), _vector(arrays[1]))
    mean, notes = _mean(top, path)
    checked = check_layers(pairs, CONVENTION, path=path, shapes=shapes)
    extras = _head(layers)
    if not all(np.isfinite(array).all() for array in extras.values()):
        raise UserError(f"{path}: NetVLAD's head has values that are not finite")
    objects = not all(layers)
    return Source(
        family="netvlad" if extras or objects else "caffe",
        path=path,
        sha256=sha256,
        layers=checked,
        convention=CONVENTION,
        preprocessing=Preprocessing(1.0, mean, (1.0, 1.0, 1.0)),
        extras=extras,
        notes=notes + (EXPORT,) * (objects and "netvlad.assignment" not in extras),
    )
