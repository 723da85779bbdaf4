"""Weights as their own framework has them, and the way from there to jaxsfm's convention."""

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
    bgr: bool
    """The network's input has the channels blue, green, red."""
    convolution: bool
    """Kernels are applied as true convolutions, turned by 180 degrees (Theano), not as
    correlations."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """A file's convolutions, as they are in it."""

    architecture: str = "vgg16"
    """One of `jaxsfm.io.weight_files.ARCHITECTURES`."""
    family: Family
    path: Path
    sha256: str
    layers: Mapping[str, tuple[np.ndarray, np.ndarray]]
    """Layer (conv1_1, ..) -> kernel in the convention's layout, bias (O,)."""
    convention: Convention
    preprocessing: Preprocessing
    """Mean and std in the order of the source's channels."""
    extras: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """`jaxsfm.io.weight_files.EXTRAS`, already in their documented form."""
    notes: tuple[str, ...] = ()
    """What the user should know, in sentences."""


def check_layers(
    layers: Mapping[str, tuple[object, object]],
    convention: Convention,
    *,
    path: Path,
    shapes: Mapping[str, tuple[int, int]],
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The layers as float32 arrays in canonical order.

    Args:
      layers: kernel and bias of each layer; None: it is not in the file.
      shapes: input and output channels of each.

    Raises:
      UserError: one is missing, of another shape, or not finite.
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
    # Overflow to infinity is found below, as what it is.
    with np.errstate(over="ignore", invalid="ignore"):
        single = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(single).all():
        raise UserError(f"{what} has values that are not finite in float32")
    return single


def canonical_layers(source: Source) -> dict[str, dict[str, np.ndarray]]:
    """The layers in jaxsfm's convention: {layer: {'kernel': HWIO, 'bias': O}}, RGB, correlation.

    Exact: values are moved, never computed with.
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
    """Mean and std in the order RGB."""
    if not source.convention.bgr:
        return source.preprocessing
    scale, mean, std = source.preprocessing
    return Preprocessing(scale, (mean[2], mean[1], mean[0]), (std[2], std[1], std[0]))
