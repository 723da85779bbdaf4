"""Keras' VGG16 (.h5): Caffe's weights, whose input is BGR in 0 .. 255 minus a mean.

Four layouts: datasets called after their layer, as Keras 1 (block1_conv1/block1_conv1_W_1:0),
Keras 2 (block1_conv1/block1_conv1/kernel:0) and whole models (model_weights/..) have them; and
Keras 3's .weights.h5, which only counts (layers/conv2d_1/vars/0). Kernels are HWIO. Keras 1 with
`dim_ordering="th"` stored OIHW, and what ran on Theano is turned by 180 degrees, because Theano
convolves where others correlate (`keras.utils.conv_utils.convert_kernel`,
`preprocess_weights_for_loading`): the public file *_th_dim_ordering_th_kernels is both.
"""

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from jaxsfm.core.vgg import LAYERS, Preprocessing
from jaxsfm.errors import UserError
from weights_conversion.source import Convention, Source, check_layers

Kernels = Literal["auto", "tensorflow", "theano"]

CAFFE_BGR = Preprocessing(scale=1.0, mean=(103.939, 116.779, 123.68), std=(1.0, 1.0, 1.0))
"""`preprocess_input` with mode="caffe": the channels of BGR."""
CHILD = Path(__file__).with_name("hdf5_child.py")
PATIENCE_S = 120.0
"""For reading 60 MB, of any disk."""


def _read_apart(path: Path) -> dict[str, np.ndarray]:
    """What `hdf5_child` finds in a file, in a process of its own."""
    with tempfile.TemporaryDirectory() as scratch:
        found = Path(scratch) / "found.npz"
        command = [sys.executable, "-P", str(CHILD), str(path.absolute()), str(found)]
        try:
            child = subprocess.run(
                command, capture_output=True, timeout=PATIENCE_S, check=False, text=True
            )
        except subprocess.TimeoutExpired:
            raise UserError(
                f"{path}: damaged (the HDF5 library was not done after {PATIENCE_S:g} s)"
            ) from None
        if child.returncode != 0:
            reason = child.stderr.strip().splitlines() if child.returncode == 1 else []
            raise UserError(
                f"{path}: {reason[-1] if reason else 'damaged (the HDF5 library crashed)'}"
            )
        with np.load(found, allow_pickle=False) as arrays:
            return dict(arrays)


def _by_layer(found: dict[str, np.ndarray]) -> dict[str, tuple[object, object]]:
    """Kernel and bias of each layer; those that are only counted come in the network's order."""
    counted = {str(k): layer for k, layer in enumerate(LAYERS)}
    keys = {layer: layer for layer in LAYERS}
    keys |= {layer: k for k, layer in counted.items() if f"{k}.kernel" in found}
    return {layer: (found.get(f"{k}.kernel"), found.get(f"{k}.bias")) for layer, k in keys.items()}


def _convolves(path: Path, layout: str, backend: str, kernels: Kernels) -> bool:
    """Whether kernels are Theano's: as told, as the file says, as its public name says."""
    if kernels != "auto":
        return kernels == "theano"
    if backend:
        return backend == "theano"
    for word, theano in (("th_kernels", True), ("tf_kernels", False)):
        if word in path.name:
            return theano
    if layout == "HWIO":
        return False
    raise UserError(
        f"{path}: nothing in it says whether its kernels are Theano's, turned by 180 degrees; "
        "say --kernels theano (the public file th_dim_ordering_th_kernels) or tensorflow"
    )


def read_keras(
    path: Path,
    *,
    sha256: str,
    kernels: Kernels = "auto",
    shapes: Mapping[str, tuple[int, int]] = LAYERS,
) -> Source:
    """Weights of keras.applications.VGG16, with or without its classifier.

    Args:
      kernels: theano: turned by 180 degrees; auto: what the file says (its attribute `backend`),
        or its public name, or, of HWIO kernels, not turned.

    Raises:
      UserError: it is damaged, not a VGG-16, or its kernels may be either.
    """
    found = _read_apart(path)
    arrays = _by_layer(found)
    first = arrays["conv1_1"][0]
    layout = "OIHW" if isinstance(first, np.ndarray) and first.shape[2:] == (3, 3) else "HWIO"
    convention = Convention(layout, True, _convolves(path, layout, str(found["backend"]), kernels))
    return Source(
        family="keras",
        path=path,
        sha256=sha256,
        layers=check_layers(arrays, convention, path=path, shapes=shapes),
        convention=convention,
        preprocessing=CAFFE_BGR,
    )
