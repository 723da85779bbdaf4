"""Keras' VGG16 (.h5): Caffe's weights, whose input is BGR in 0 .. 255 minus a mean.

Four layouts: datasets called after their layer, as Keras 1 (block1_conv1/block1_conv1_W_1:0),
Keras 2 (block1_conv1/block1_conv1/kernel:0) and whole models (model_weights/..) have them; and
Keras 3's .weights.h5, which only counts (layers/conv2d_1/vars/0). Kernels are HWIO. Keras 1 with
`dim_ordering="th"` stored OIHW, and what ran on Theano is turned by 180 degrees, because Theano
convolves where others correlate (`keras.utils.conv_utils.convert_kernel`,
`preprocess_weights_for_loading`): the public file *_th_dim_ordering_th_kernels is both.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from jaxsfm.core.vgg import LAYERS, Preprocessing
from jaxsfm.errors import UserError
from weights_conversion.source import Convention, Source, check_layers

Kernels = Literal["auto", "tensorflow", "theano"]

CAFFE_BGR = Preprocessing(scale=1.0, mean=(103.939, 116.779, 123.68), std=(1.0, 1.0, 1.0))
"""`preprocess_input` with mode="caffe": the channels of BGR."""
MAX_VALUES = 1 << 22
"""In a dataset that is read: the largest kernel has 2.4 million; the classifier's are left out."""
_NAMED = re.compile(r"(?:^|/)(?:block)?(?:conv)?([1-5])_(?:conv)?([1-3])(?:/|$)")
_COUNTED = re.compile(r"(?:^|/)layers/conv2d(?:_(\d+))?/vars/[01]$")


def _layer(name: str) -> str | None:
    """The canonical layer that a dataset's path belongs to."""
    if counted := _COUNTED.search(name):
        index = int(counted[1] or 0)
        return list(LAYERS)[index] if index < len(LAYERS) else None
    if named := _NAMED.search(name):
        return f"conv{named[1]}_{named[2]}"
    return None


def _arrays(file: h5py.File, path: Path) -> dict[str, tuple[np.ndarray | None, np.ndarray | None]]:
    """Kernel and bias of each layer; soft and external links are not followed."""
    found: dict[str, dict[int, np.ndarray]] = {}

    def visit(name: str, item: object) -> None:
        layer = _layer(name)
        if layer is None or not isinstance(item, h5py.Dataset) or item.ndim not in (1, 4):
            return
        if item.is_virtual or item.external:
            raise UserError(f"{path}: {name} lies in another file, which is not followed")
        if math.prod(item.shape) > MAX_VALUES or item.dtype.kind != "f":
            raise UserError(f"{path}: {name} is no layer of VGG-16 ({item.dtype} {item.shape})")
        if item.ndim in found.setdefault(layer, {}):
            raise UserError(f"{path}: {layer} is in it more than once ({name})")
        found[layer][item.ndim] = item[()]

    file.visititems(visit)
    return {layer: (arrays.get(4), arrays.get(1)) for layer, arrays in found.items()}


def _backend(file: h5py.File) -> str | None:
    """What the weights ran on, where the file says so; Keras 1.0 did not."""
    for group in (file, file.get("model_weights")):
        if isinstance(group, h5py.Group) and "backend" in group.attrs:
            value = group.attrs["backend"]
            return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
    return None


def _convolves(path: Path, layout: str, backend: str | None, kernels: Kernels) -> bool:
    """Whether kernels are Theano's: as told, as the file says, as its public name says."""
    if kernels != "auto":
        return kernels == "theano"
    if backend is not None:
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
    try:
        with h5py.File(path, "r") as file:
            arrays, backend = _arrays(file, path), _backend(file)
    except UserError:
        raise
    except Exception as error:  # a damaged file can raise almost anything
        raise UserError(f"{path}: not a readable HDF5 file of Keras ({error})") from error
    first, _ = arrays.get("conv1_1", (None, None))
    layout = "OIHW" if first is not None and first.shape[2:] == (3, 3) else "HWIO"
    convention = Convention(layout, True, _convolves(path, layout, backend, kernels))
    return Source(
        family="keras",
        path=path,
        sha256=sha256,
        layers=check_layers(arrays, convention, path=path, shapes=shapes),
        convention=convention,
        preprocessing=CAFFE_BGR,
    )
