"""The convolutions in an HDF5 file of Keras: a script for a process of its own.

libhdf5 may loop for ever on a damaged file (2.0: an attribute among a thousand mutated files) or
crash, and nothing in its process can end that. `weights_conversion.keras_files` runs this file with
two arguments, the HDF5 file and an .npz for what is found, and imports nothing of ours here: a
second instead of five.
"""

import math
import re
import sys

import h5py
import numpy as np

MAX_VALUES = 1 << 22
"""In a dataset that is read: the largest kernel has 2.4 million; the classifier's are left out."""
_NAMED = re.compile(r"(?:^|/)(?:block)?(?:conv)?([1-5])_(?:conv)?([1-3])(?:/|$)")
_COUNTED = re.compile(r"(?:^|/)layers/conv2d(?:_(\d{1,2}))?/vars/[01]$")


class Refused(Exception):
    """Why a file is none of Keras' VGG-16, in words."""


def layer_of(name: str) -> str | None:
    """conv1_1 of a dataset called after its layer, the number of one that is counted; None for
    anything else, and for an optimizer's moments."""
    if name.startswith("optimizer"):
        return None
    if counted := _COUNTED.search(name):
        return counted[1] or "0"
    named = _NAMED.search(name)
    return named and f"conv{named[1]}_{named[2]}"


def convolutions(file: h5py.File) -> dict[str, np.ndarray]:
    """LAYER.kernel and LAYER.bias; soft and external links are not followed.

    Raises:
      Refused: a layer is there twice, lies elsewhere, or is too large.
    """
    found: dict[str, np.ndarray] = {}

    def visit(name: str, item: object) -> None:
        layer = layer_of(name)
        if layer is None or not isinstance(item, h5py.Dataset) or item.ndim not in (1, 4):
            return
        if item.is_virtual or item.external:
            raise Refused(f"{name} lies in another file, which is not followed")
        if math.prod(item.shape) > MAX_VALUES or item.dtype.kind != "f":
            raise Refused(f"{name} is no layer of VGG-16 ({item.dtype} {item.shape})")
        key = f"{layer}.{'kernel' if item.ndim == 4 else 'bias'}"
        if key in found:
            raise Refused(f"{key} is in it more than once ({name})")
        found[key] = item[()]

    file.visititems(visit)
    return found


def backend(file: h5py.File) -> str:
    """What the weights ran on, "" where the file does not say so (Keras 1.0, .weights.h5)."""
    for group in (file, file.get("model_weights")):
        if isinstance(group, h5py.Group) and "backend" in group.attrs:
            value = group.attrs["backend"]
            return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
    return ""


def main(source: str, target: str) -> int:
    """0, or 1 and the reason on standard error."""
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
