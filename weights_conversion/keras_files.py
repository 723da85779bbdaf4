"""Reads Keras' VGG16 (.h5). These are Caffe's weights; their input is BGR in 0 .. 255 minus a mean.

There are four layouts. In three of them datasets are called after their layer: Keras 1
(block1_conv1/block1_conv1_W_1:0), Keras 2 (block1_conv1/block1_conv1/kernel:0) and whole models
(model_weights/..). In the fourth, Keras 3's .weights.h5, they are numbered:
layers/conv2d_1/vars/0.

Kernels are HWIO, or OIHW if Keras 1 wrote them with `dim_ordering="th"`. Kernels for Theano are
turned by 180 degrees, because Theano convolves where the others correlate
(`keras.utils.conv_utils.convert_kernel`, `preprocess_weights_for_loading`). The public file
*_th_dim_ordering_th_kernels is OIHW and turned.
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
from jaxsfm.io.extras import require
from jaxsfm.weights_conversion.source import Convention, Source, check_layers

Kernels = Literal["auto", "tensorflow", "theano"]

CAFFE_BGR = Preprocessing(scale=1.0, mean=(103.939, 116.779, 123.68), std=(1.0, 1.0, 1.0))
"""`preprocess_input` with mode="caffe"; the channels are in the order BGR."""
CHILD = Path(__file__).with_name("hdf5_child.py")
PATIENCE_S = 120.0
"""How long the child may take, seconds: enough to read 60 MB from any disk."""


def _read_apart(path: Path) -> dict[str, np.ndarray]:
    """Run `hdf5_child` in a process of its own and return what it finds in a file."""
    with tempfile.TemporaryDirectory() as scratch:
        found = Path(scratch) / "found.npz"
        command = [sys.executable, "-P", str(CHILD), str(path.absolute()), str(found)]
        try:
            child = subprocess.run(
                command, capture_output=True, timeout=PATIENCE_S, check=False, text=True
            )
        except subprocess.TimeoutExpired:
            raise UserError(
                f"{path}: damaged (the HDF5 library had not finished after {PATIENCE_S:g} s)"
            ) from None
        if child.returncode != 0:
            reason = child.stderr.strip().splitlines() if child.returncode == 1 else []
            raise UserError(
                f"{path}: {reason[-1] if reason else 'damaged (the HDF5 library crashed)'}"
            )
        with np.load(found, allow_pickle=False) as arrays:
            return dict(arrays)


def _by_layer(found: dict[str, np.ndarray]) -> dict[str, tuple[object, object]]:
    """Return kernel and bias of each layer; numbered layers are in the order of the network."""
    counted = {str(k): layer for k, layer in enumerate(LAYERS)}
    keys = {layer: layer for layer in LAYERS}
    keys |= {layer: k for k, layer in counted.items() if f"{k}.kernel" in found}
    return {layer: (found.get(f"{k}.kernel"), found.get(f"{k}.bias")) for layer, k in keys.items()}


def _convolves(path: Path, layout: str, backend: str, kernels: Kernels) -> bool:
    """Whether the kernels are for Theano.

    The option decides, else the file itself, else the name under which the file is public.
    """
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
        f"{path}: the file does not say whether its kernels are turned by 180 degrees, for Theano; "
        "give --kernels theano (the public file th_dim_ordering_th_kernels) or tensorflow"
    )


def read_keras(
    path: Path,
    *,
    sha256: str,
    kernels: Kernels = "auto",
    shapes: Mapping[str, tuple[int, int]] = LAYERS,
) -> Source:
    """Read the weights of keras.applications.VGG16, with or without its classifier.

    Args:
      path: the file.
      sha256: its hash.
      kernels: theano: the kernels are turned by 180 degrees; tensorflow: they are not; auto: the
        file's attribute `backend` decides, else its public name; HWIO kernels are else not turned.
      shapes: input and output channels of each layer.

    Raises:
      UserError: the file is damaged or not a VGG-16, nothing says whether kernels are turned, or
        h5py is not installed.
    """
    require("hdf5", f"{path}: reading HDF5 files needs")  # here, as the child would say it worse
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
