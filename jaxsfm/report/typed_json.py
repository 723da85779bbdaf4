"""Dataclasses written as JSON and read back, with every value checked.

The type hints of a dataclass are its schema. Supported are `bool`, `int`, `float`, `str`, `object`
(any JSON value, taken as it is), `Literal`, enumerations (their names in lower case), `X | None`,
`list`, `tuple`, `dict[str, X]`, other dataclasses, and `Annotated[X, Range(...)]`. A key that the
dataclass does not name is ignored, unless the dataclass has a field marked with `OTHERS`.
"""

import dataclasses
import enum
import functools
import itertools
import reprlib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeVar

from jaxsfm.io.atomic import Json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
K = TypeVar("K")
OMITTED = {"omitted": True}
"""Metadata of a field that is left out of the JSON where it is None or an empty dict."""
OTHERS = {"others": True}
"""Metadata of a field dict[str, object] that holds the keys which the dataclass does not name."""


class Range(NamedTuple):
    """Bounds of a number: low <= number < high."""

    low: float
    high: float


Count = Annotated[int, Range(0, 2**53)]
"""A number of things."""
Number = Annotated[float, Range(-1e30, 1e30)]
"""A finite number, of which sums and products stay finite too."""


class Misfit(ValueError):
    """A JSON value is not what a type hint asks for."""

    def __init__(self, required: str, got: object) -> None:
        super().__init__(required, got)
        self.required, self.got = required, reprlib.repr(got)
        self.path: list[str] = []
        """Keys and indices that lead to the value, the last one first."""

    @property
    def place(self) -> str:
        """Where the value is, for example `pairs.each.1.inliers`; empty: it is the whole."""
        return ".".join(reversed(self.path))

    def __str__(self) -> str:
        return f"{self.place or 'the whole'!r} must be {self.required}; got {self.got}"


def to_json(value: "DataclassInstance") -> dict[str, Json]:
    """A dataclass as plain JSON."""
    plain: dict[str, Json] = {}
    for field in dataclasses.fields(value):
        each = getattr(value, field.name)
        if field.metadata == OTHERS:
            plain.update(each)
        elif field.metadata != OMITTED or (each is not None and each != {}):
            plain[field.name] = _plain(each)
    return plain


def _plain(value: object) -> Json:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_json(value)
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"value must be plain or a dataclass; got {type(value).__name__}")


def from_json(kind: type[T], value: object, *, exact: bool = False) -> T:
    """A dataclass from plain JSON; Misfit if the value is not what the type hints ask for.

    Args:
      exact: whether a key that no dataclass names is an error. It is ignored otherwise.
    """
    made = _read(kind, value, exact)
    assert isinstance(made, kind)
    return made


def _read(hint: object, value: object, exact: bool) -> object:
    """The value that a type hint asks for."""
    if isinstance(hint, type):
        return _read_type(hint, value, exact)
    origin, args = _parts(hint)
    if origin in (typing.Union, types.UnionType):
        (other,) = (arg for arg in args if arg is not types.NoneType)
        return None if value is None else _read(other, value, exact)
    if origin is Annotated:
        number, (low, high) = _read(args[0], value, exact), args[1]
        assert isinstance(number, int | float)
        if not low <= number < high:
            raise Misfit(f"at least {low:g} and less than {high:g}", value)
        return number
    if origin is typing.Literal:
        if not isinstance(value, str) or value not in args:
            raise Misfit("one of " + ", ".join(map(repr, args)), value)
        return value
    if origin is dict:
        return _read_items(itertools.repeat(args[1]), _object(value), exact)
    assert origin in (list, tuple), hint
    if not isinstance(value, list):
        raise Misfit("a list", value)
    if origin is tuple and len(value) != len(args):
        raise Misfit(f"a list of {len(args)}", value)
    hints = args if origin is tuple else itertools.repeat(args[0])
    items = _read_items(hints, dict(enumerate(value)), exact)
    return origin(items.values())


_parts = functools.cache(lambda hint: (typing.get_origin(hint), typing.get_args(hint)))


def _read_type(kind: type, value: object, exact: bool) -> object:
    if dataclasses.is_dataclass(kind):
        return _read_dataclass(kind, _object(value), exact)
    if issubclass(kind, enum.Enum):
        members = {name.lower(): member for name, member in kind.__members__.items()}
        if not isinstance(value, str) or value not in members:
            raise Misfit("one of " + ", ".join(map(repr, members)), value)
        return members[value]
    if kind is float:
        try:
            if isinstance(value, int | float) and not isinstance(value, bool):
                return float(value)
        except OverflowError:
            pass
        raise Misfit("a number", value)
    if kind is not object and type(value) is not kind:
        raise Misfit(f"of type {kind.__name__}", value)
    return value


def _object(value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        raise Misfit("an object", value)
    return value


def _read_items(hints: Iterable[object], items: Mapping[K, object], exact: bool) -> dict[K, object]:
    """Read the parts of a value; an error says where the part is."""
    found = {}
    for hint, (key, item) in zip(hints, items.items(), strict=False):
        try:
            found[key] = _read(hint, item, exact)
        except Misfit as misfit:
            misfit.path.append(str(key))
            raise
    return found


@functools.cache
def _schema(kind: "type[DataclassInstance]") -> tuple[dict[str, object], list[str], str | None]:
    """The type hints of a dataclass, the keys that it requires, and the field of all other keys."""
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = dataclasses.fields(kind)
    others = next((field.name for field in fields if field.metadata == OTHERS), None)
    absent = (dataclasses.MISSING, dataclasses.MISSING)
    required = [f.name for f in fields if (f.default, f.default_factory) == absent]
    return {f.name: hints[f.name] for f in fields if f.name != others}, required, others


def _read_dataclass(
    kind: "type[DataclassInstance]", value: dict[str, object], exact: bool
) -> object:
    hints, required, others = _schema(kind)
    for name in required:
        if name not in value:
            raise Misfit(f"an object with the key {name!r}", value)
    known = {name: value[name] for name in hints if name in value}
    made = _read_items((hints[name] for name in known), known, exact)
    left = {key: each for key, each in value.items() if key not in hints}
    if others is not None:
        made[others] = left
    elif exact and left:
        raise Misfit(f"an object without the key {next(iter(left))!r}", value)
    return kind(**made)
