"""Reads PyTorch's files of tensors, without PyTorch and without running anything in them.

There are two formats. Since PyTorch 1.6 a file is a zip with `data.pkl` and one member `data/KEY`
for each storage. Older files, such as torchvision's public file of 2017, are a sequence of five
pickles: magic number, protocol version, system, the object, and the keys of the storages. Each
storage follows, as its number of elements (int64) and its elements. Source: torch/serialization.py.
"""

import collections
import io
import math
import pickle
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from jaxsfm.errors import UserError

MAGIC = 0x1950A86A20F9469CFC6C
PROTOCOL = 1001
MAX_NAMES = 1 << 20
"""The most bytes of the pickle in a zip, without its storages; VGG-16's has some thousand."""
DTYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}
"""The dtypes of torch's storage classes. bfloat16 is refused, because numpy does not have it."""


class _StorageClass(NamedTuple):
    """Stands for one of torch's storage classes."""

    dtype: np.dtype


class _Storage(NamedTuple):
    """A storage whose elements have not been read yet."""

    dtype: np.dtype
    key: str
    elements: int


class _Tensor(NamedTuple):
    """A view of a storage. Offset, size and stride are counted in elements."""

    storage: _Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    def __setstate__(self, state: object) -> None:
        """Ignore the state: in files of 2017 it says whether a parameter is trained."""


class _Rebuild:
    """Stands for torch's functions that make tensors.

    A pickle may set attributes of the objects that it finds. An instance without attributes does
    not allow that; a function would.
    """

    __slots__ = ()

    def __call__(
        self, storage: object, offset: object, size: object, stride: object, *_: object
    ) -> _Tensor:
        if not isinstance(storage, _Storage):
            raise pickle.UnpicklingError("a tensor without a storage")
        (start,), sizes, strides = _counts((offset,)), _counts(size), _counts(stride)
        if len(sizes) != len(strides):
            raise pickle.UnpicklingError("a tensor of no possible shape")
        return _Tensor(storage, start, sizes, strides)


def _counts(values: object) -> tuple[int, ...]:
    """Whole numbers of at least 0, which a pickle has as a tuple or list."""
    if not isinstance(values, tuple | list):
        raise pickle.UnpicklingError("a tensor of no possible shape")
    if not all(type(v) is int and v >= 0 for v in values):
        raise pickle.UnpicklingError("a tensor of no possible shape")
    return tuple(values)


class _Parameter:
    """Stands for torch's parameters, which are their tensors here."""

    __slots__ = ()

    def __call__(self, data: object, *_: object) -> object:
        return data


ADMITTED: dict[tuple[str, str], Callable[..., object]] = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor"): _Rebuild(),
    ("torch._utils", "_rebuild_tensor_v2"): _Rebuild(),
    ("torch._utils", "_rebuild_parameter"): _Parameter(),
    ("torch.nn.parameter", "Parameter"): _Parameter(),
}


class _TensorUnpickler(pickle.Unpickler):
    """Admits dictionaries and tensors; any other name is refused before it is looked up."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> object:
        if module == "torch" and name in DTYPES:
            return _StorageClass(np.dtype(DTYPES[name]))
        try:
            return ADMITTED[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed") from None

    def persistent_load(self, pid: object) -> _Storage:
        if not isinstance(pid, tuple):
            raise pickle.UnpicklingError("a persistent id that is not a storage")
        kind, storage, key, _, elements, *view = pid
        sound = isinstance(storage, _StorageClass) and type(elements) is int and elements >= 0
        if kind != "storage" or not sound or any(view):
            raise pickle.UnpicklingError("a persistent id that is not a storage")
        found = _Storage(storage.dtype, str(key), elements)
        if self.storages.setdefault(found.key, found) != found:
            raise pickle.UnpicklingError(f"storage {key} of two kinds")
        return found


def read_tensors(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read those of the named tensors that are in the state dict of a file.

    Raises:
      UserError: the file is not a PyTorch file, is damaged, or names something that tensors do not
        need.
    """
    try:
        with path.open("rb") as file:
            state, elements = _zipped(file) if zipfile.is_zipfile(file) else _legacy(file)
            if not isinstance(state, dict):
                raise ValueError(f"a dictionary of tensors is expected; got {type(state).__name__}")
            found = {name: state.get(name) for name in names}
            return {
                name: _view(tensor, elements(tensor.storage))
                for name, tensor in found.items()
                if isinstance(tensor, _Tensor)
            }
    except Exception as error:  # a damaged pickle can raise almost anything
        raise UserError(f"{path}: not a readable PyTorch file of weights ({error})") from error


def _view(tensor: _Tensor, elements: np.ndarray) -> np.ndarray:
    steps = [(n - 1) * s for n, s in zip(tensor.size, tensor.stride, strict=True)]
    count = math.prod(tensor.size)
    if not 0 < count <= elements.size or tensor.offset + sum(steps) >= elements.size:
        raise ValueError(f"a tensor of size {tensor.size} reaches past its storage")
    return np.lib.stride_tricks.as_strided(
        elements[tensor.offset :],
        tensor.size,
        [stride * elements.itemsize for stride in tensor.stride],
        writeable=False,
    )


def _zipped(file: BinaryIO) -> tuple[object, Callable[[_Storage], np.ndarray]]:
    """Read a file of PyTorch 1.6 or later: the object, and a reader of storages."""
    archive = zipfile.ZipFile(file)
    members = {name.partition("/")[2]: name for name in archive.namelist()}

    def member(name: str, limit: int) -> bytes:
        if name not in members:
            raise ValueError(f"{name} is missing in it")
        info = archive.getinfo(members[name])
        if info.file_size > limit:
            raise ValueError(f"{name} has {info.file_size} bytes; at most {limit} are expected")
        return archive.read(info)

    if "byteorder" in members and member("byteorder", 16) != b"little":
        raise ValueError("its numbers are not little-endian")
    state = _TensorUnpickler(io.BytesIO(member("data.pkl", MAX_NAMES))).load()

    def elements(storage: _Storage) -> np.ndarray:
        data = member(f"data/{storage.key}", storage.elements * storage.dtype.itemsize)
        return np.frombuffer(data, storage.dtype, storage.elements)

    return state, elements


def _legacy(file: BinaryIO) -> tuple[object, Callable[[_Storage], np.ndarray]]:
    """Read a file of an older PyTorch: the object, and a reader of storages."""
    file.seek(0)
    if _TensorUnpickler(file).load() != MAGIC or _TensorUnpickler(file).load() != PROTOCOL:
        raise ValueError("not PyTorch's magic number and protocol")
    if _TensorUnpickler(file).load().get("little_endian") is not True:
        raise ValueError("its numbers are not little-endian")
    unpickler = _TensorUnpickler(file)
    state = unpickler.load()
    starts = {}
    for key in _TensorUnpickler(file).load():
        storage = unpickler.storages.get(str(key))
        count = int.from_bytes(file.read(8), "little")
        if storage is None or count != storage.elements:
            raise ValueError(f"storage {key} is not as the tensors say")
        starts[storage.key] = file.tell()
        file.seek(count * storage.dtype.itemsize, io.SEEK_CUR)

    def elements(storage: _Storage) -> np.ndarray:
        file.seek(starts[storage.key])
        data = file.read(storage.elements * storage.dtype.itemsize)
        return np.frombuffer(data, storage.dtype, storage.elements)

    return state, elements
