"""A script that reads the convolutions from an HDF5 file of Keras, in a process of its own.

On a damaged file libhdf5 may crash or loop for ever (version 2.0 did, on one of a thousand mutated
files), and nothing in the same process can end that. So `weights_conversion.keras_files` runs this
file as a program. Its two arguments are the HDF5 file and an .npz file for the result. It imports
nothing of jaxsfm, and so takes one second instead of five.
"""

import math
import re
import sys

import h5py
import numpy as np

MAX_VALUES = 1 << 22
"""The most values of a dataset that is read. The largest kernel has 2.4 million; the layers of the
classifier are larger, and they are not needed."""
_NAMED = re.compile(r"(?:^|/)(?:block)?(?:conv)?([1-5])_(?:conv)?([1-3])(?:/|$)")
_COUNTED = re.compile(r"(?:^|/)layers/conv2d(?:_(\d{1,2}))?/vars/[01]$")


class Refused(Exception):
    """The file is not a VGG-16 of Keras; the text says why."""


def layer_of(name: str) -> str | None:
    """Return the layer of a dataset: its name (conv1_1), or its number if datasets are numbered.

    The result is None for anything else, for example the moments of an optimizer.
    """
    if name.startswith("optimizer"):
        return None
    if counted := _COUNTED.search(name):
        return counted[1] or "0"
    named = _NAMED.search(name)
    return named and f"conv{named[1]}_{named[2]}"


def convolutions(file: h5py.File) -> dict[str, np.ndarray]:
    """Read the arrays LAYER.kernel and LAYER.bias. Soft and external links are not followed.

    Raises:
      Refused: a layer is in the file twice, is in another file, or is too large.
    """
    found: dict[str, np.ndarray] = {}

    def visit(name: str, item: object) -> None:
        layer = layer_of(name)
        if layer is None or not isinstance(item, h5py.Dataset) or item.ndim not in (1, 4):
            return
        if item.is_virtual or item.external:
            raise Refused(f"{name} is in another file, which is not read")
        if math.prod(item.shape) > MAX_VALUES or item.dtype.kind != "f":
            raise Refused(f"{name} is not a layer of VGG-16 ({item.dtype} {item.shape})")
        key = f"{layer}.{'kernel' if item.ndim == 4 else 'bias'}"
        if key in found:
            raise Refused(f"{key} is in the file more than once ({name})")
        found[key] = item[()]

    file.visititems(visit)
    return found


def backend(file: h5py.File) -> str:
    """Return the backend that the weights were used with.

    It is "" if the file does not say (Keras 1.0, .weights.h5).
    """
    for group in (file, file.get("model_weights")):
        if isinstance(group, h5py.Group) and "backend" in group.attrs:
            value = group.attrs["backend"]
            return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
    return ""


def main(source: str, target: str) -> int:
    """Read the file and write the arrays; return 0, or 1 with the reason on standard error."""
    try:
        with h5py.File(source, "r") as file:
            found = convolutions(file) | {"backend": np.asarray(backend(file))}
        np.savez(target, **found)  # pyright: ignore[reportArgumentType]  names are no options
    except Refused as error:
        print(error, file=sys.stderr)
        return 1
    except Exception as error:  # a damaged file can raise almost anything
        print(f"not a readable HDF5 file of Keras ({error})", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
