"""Files that hold values of given types: JSON for others to read, MessagePack for jaxsfm alone.

The type hints say what a file holds, and msgspec checks it. MessagePack keeps what JSON has not:
tuples as keys of dictionaries, sets, and numbers that are not finite.
"""

import json
from pathlib import Path
from typing import TypeVar

import msgspec

T = TypeVar("T")


def read_json(path: Path, kind: type[T]) -> T | None:
    """The content of a JSON file; None if it cannot be read, or is not of this kind."""
    try:
        # msgspec's own reader refuses file names that are not UTF-8, which `json` writes escaped.
        return msgspec.convert(json.loads(path.read_text(encoding="utf-8")), kind)
    except (OSError, ValueError, RecursionError):
        return None


def write_figures(path: Path, value: object) -> None:
    """Write dataclasses, tuples, lists, dictionaries and sets of plain values as MessagePack."""
    path.write_bytes(msgspec.msgpack.encode(value, enc_hook=_float))


def read_figures(path: Path, kind: type[T]) -> T:
    """Read what `write_figures` wrote."""
    return msgspec.msgpack.decode(path.read_bytes(), type=kind)


def _float(value: object) -> float:
    """The value of a NumPy float64, which is a float that msgspec does not take for one."""
    if isinstance(value, float):
        return float(value)
    raise TypeError(f"value must be plain; got {type(value).__name__}")
