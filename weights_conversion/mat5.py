"""Reads numbers, texts, cells and structs from MATLAB files of version 5.

scipy.io.loadmat is not used, because it ends the process with a segmentation fault on some damaged
files (version 1.17, after one of some hundred mutations). The arrays are views of the mapped file.

Source: MAT-File Format (The MathWorks, R2023b), level 5.
"""

import math
import mmap
import struct
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import TypeAlias

import numpy as np

Value: TypeAlias = np.ndarray | str | list["Value"] | dict[str, "Value"] | None
"""Numbers are arrays, texts str, cells lists (column by column) and structs dicts; an array of
several structs is a list. None stands for anything else."""

MAX_VARIABLE = 1 << 30
"""The most bytes of a variable after decompression; NetVLAD's network has 0.6 times as many."""
MAX_DEPTH = 16
"""How deeply cells and structs may be nested."""
HEADER = 128
NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
MATRIX, COMPRESSED = 14, 15
CELL, STRUCT, CHAR = 1, 2, 4
NUMERIC = {
    6: "f8",
    7: "f4",
    8: "i1",
    9: "u1",
    10: "i2",
    11: "u2",
    12: "i4",
    13: "u4",
    14: "i8",
    15: "u8",
}
COMPLEX = 0x0800


class _Elements:
    """A sequence of data elements in a part of a file."""

    def __init__(self, data: memoryview, order: str, depth: int = 0) -> None:
        self.data, self.order, self.depth, self.at = data, order, depth, 0
        if depth > MAX_DEPTH:
            raise ValueError(f"cells and structs are nested more than {MAX_DEPTH} times")

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def next(self) -> tuple[int, memoryview]:
        """Return the type and the bytes of the next element."""
        kind, size = struct.unpack_from(f"{self.order}II", self.data, self.at)
        if (
            kind >> 16
        ):  # a small element: size, type and up to four data bytes, together eight bytes
            kind, size, start, padded = kind & 0xFFFF, kind >> 16, self.at + 4, 4
            if size > 4:
                raise ValueError("a small element of more than four bytes")
        else:
            start = self.at + 8
            padded = size if kind == COMPRESSED else -(-size // 8) * 8
        if start + size > len(self.data):
            raise ValueError("an element that reaches past the end")
        self.at = start + padded
        return kind, self.data[start : start + size]

    def numbers(self) -> np.ndarray:
        """Read the next element as numbers."""
        kind, data = self.next()
        if kind not in NUMBERS:
            raise ValueError(f"numbers are expected; got an element of type {kind}")
        return np.frombuffer(data, self.order + NUMBERS[kind])

    def text(self) -> str:
        """Read the next element as text."""
        kind, data = self.next()
        if kind not in TEXTS:
            raise ValueError(f"text is expected; got an element of type {kind}")
        wide = {"<": "-le", ">": "-be"}[self.order] * TEXTS[kind].startswith(("utf-16", "utf-32"))
        return bytes(data).decode(TEXTS[kind] + wide, errors="replace")

    def matrix(self) -> tuple[str, Value]:
        """Read the next array; return its name and value."""
        kind, data = self.next()
        if kind != MATRIX:
            raise ValueError(f"an array is expected; got an element of type {kind}")
        if not data:
            return "", np.zeros((0, 0))
        return _array(_Elements(data, self.order, self.depth + 1))


def _array(part: _Elements) -> tuple[str, Value]:
    flags = int(part.numbers()[0])
    kind = flags & 0xFF
    if kind not in (CELL, STRUCT, CHAR, *NUMERIC) or flags & COMPLEX:
        return "", None  # the array holds objects, functions, or sparse or complex numbers
    shape = tuple(int(n) for n in part.numbers())
    count = math.prod(shape)
    if min(shape, default=0) < 0:
        raise ValueError(f"an array of shape {shape}")
    name = part.text()
    if kind in NUMERIC:
        values = part.numbers().astype(part.order + NUMERIC[kind], copy=False)
        if values.size != count:
            raise ValueError(f"{values.size} numbers in an array of shape {shape}")
        return name, values.reshape(shape, order="F")
    if kind == CHAR:
        return name, part.text()
    fields = _field_names(part) if kind == STRUCT else [""]
    if count * len(fields) * 8 > part.left:
        raise ValueError(f"an array of shape {shape} with too few elements")
    items: list[dict[str, Value]] = [
        {field: part.matrix()[1] for field in fields} for _ in range(count)
    ]
    if kind == CELL:
        return name, [item[""] for item in items]
    return name, items[0] if count == 1 else [*items]


def _field_names(part: _Elements) -> list[str]:
    (length,) = part.numbers()
    _, data = part.next()
    if length <= 0 or len(data) % length:
        raise ValueError("a struct whose fields have no names")
    names = [bytes(data[k : k + length]) for k in range(0, len(data), int(length))]
    return [name.partition(b"\0")[0].decode("latin-1") for name in names]


def read_variables(path: Path, names: Collection[str]) -> dict[str, Value]:
    """Read those of the named variables that are in a file.

    Raises:
      ValueError, struct.error, zlib.error, OSError: the file is not a MATLAB file of version 5, or
        it is damaged.
    """
    with path.open("rb") as file:
        # The mapping is not closed here, because the arrays are views of it.
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or len(data) < HEADER:
        raise ValueError("no header of version 5")
    file_elements = _Elements(memoryview(data)[HEADER:], order)
    found = {}
    while file_elements.left >= 8:
        start = file_elements.at
        kind, content = file_elements.next()
        if kind == COMPRESSED:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(content, MAX_VARIABLE)
            if unpacker.unconsumed_tail:
                raise ValueError(f"a variable of more than {MAX_VARIABLE} bytes")
            one = _Elements(memoryview(unpacked), order)
        else:
            one = _Elements(file_elements.data[start : file_elements.at], order)
        name, value = one.matrix()
        if name in names:
            found[name] = value
    return found
