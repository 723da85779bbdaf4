"""Weights in the convention of their own framework, and their conversion to jaxsfm's."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from jaxsfm.core.vgg import Preprocessing
from jaxsfm.errors import UserError

Family = Literal["torchvision", "keras", "caffe", "netvlad"]


class Convention(NamedTuple):
    """How a framework stores kernels and channels."""

    layout: Literal["HWIO", "OIHW"]
    """The order of the axes of a kernel: height, width, input and output channels."""
    bgr: bool
    """Whether the channels of the network's input are blue, green, red."""
    convolution: bool
    """Whether kernels are applied as true convolutions (Theano) and not as correlations; they are
    then turned by 180 degrees."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """The convolutions of a file, in the convention of the file."""

    architecture: str = "vgg16"
    """One of `jaxsfm.io.weight_files.ARCHITECTURES`."""
    family: Family
    path: Path
    sha256: str
    layers: Mapping[str, tuple[np.ndarray, np.ndarray]]
    """Layer (conv1_1, ..) -> the kernel, in the layout of the convention, and the bias (O,)."""
    convention: Convention
    preprocessing: Preprocessing
    """What the network expects of an image; the channels are in the order of the source."""
    extras: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Those of `jaxsfm.io.weight_files.EXTRAS` that the file has, in the form documented there."""
    notes: tuple[str, ...] = ()
    """Sentences that tell the user what is unusual about the file."""


def check_layers(
    layers: Mapping[str, tuple[object, object]],
    convention: Convention,
    *,
    path: Path,
    shapes: Mapping[str, tuple[int, int]],
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Check the layers and return them as float32 arrays, in the order of `shapes`.

    Args:
      layers: kernel and bias of each layer; None stands for an array that is not in the file.
      convention: how kernels are stored.
      path: the file, for messages.
      shapes: input and output channels of each layer.

    Raises:
      UserError: an array is missing, has another shape, or has values that are not finite.
    """
    checked = {}
    for name, (inputs, outputs) in shapes.items():
        kernel, bias = layers.get(name, (None, None))
        sizes = {"H": 3, "W": 3, "I": inputs, "O": outputs}
        wanted = tuple(sizes[axis] for axis in convention.layout)
        checked[name] = (
            _checked(kernel, wanted, f"{path}: the kernel of {name}"),
            _checked(bias, (outputs,), f"{path}: the bias of {name}"),
        )
    return checked


def _checked(array: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    if array is None:
        raise UserError(f"{what} is missing")
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f" or array.shape != shape:
        got = getattr(array, "dtype", type(array).__name__), getattr(array, "shape", "")
        raise UserError(f"{what} must be an array of floats {shape}; got {got[0]} {got[1]}")
    # A value that overflows to infinity is refused below.
    with np.errstate(over="ignore", invalid="ignore"):
        single = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(single).all():
        raise UserError(f"{what} has values that are not finite in float32")
    return single


def canonical_layers(source: Source) -> dict[str, dict[str, np.ndarray]]:
    """Convert the layers to jaxsfm's convention: kernels are HWIO, RGB, and correlate.

    The conversion is exact, because it moves values and does not compute with them.

    Returns: {layer: {'kernel': HWIO, 'bias': O}}.
    """
    layers = {}
    for name, (kernel, bias) in source.layers.items():
        if source.convention.layout == "OIHW":
            kernel = kernel.transpose(2, 3, 1, 0)
        if source.convention.convolution:
            kernel = kernel[::-1, ::-1]
        if source.convention.bgr and name == "conv1_1":
            kernel = kernel[:, :, ::-1]
        layers[name] = {"kernel": np.ascontiguousarray(kernel), "bias": bias}
    return layers


def canonical_preprocessing(source: Source) -> Preprocessing:
    """Return the preprocessing with mean and deviation in the order RGB."""
    if not source.convention.bgr:
        return source.preprocessing
    scale, mean, std = source.preprocessing
    return Preprocessing(scale, (mean[2], mean[1], mean[0]), (std[2], std[1], std[0]))
