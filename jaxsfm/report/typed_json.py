"""Dataclasses written as JSON and read back, with every value checked.

The type hints of a dataclass are its schema. Supported are `bool`, `int`, `float`, `str`, `object`
(any JSON value, taken as it is), `Literal`, enumerations (their names in lower case), `X | None`,
`list`, `tuple`, `dict[str, X]`, other dataclasses, and `Annotated[X, Range(...)]`. A key that the
dataclass does not name is ignored, unless the dataclass has a field marked with `OTHERS`.
"""

import dataclasses
import enum
import functools
import reprlib
import types
import typing
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, TypeVar

from jaxsfm.io.atomic import Json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
Read = Callable[[object], object]
"""Checks a JSON value and converts it; raises Misfit."""

OMITTED = {"omitted": True}
"""Metadata of a field that is left out of the JSON where it is None."""
OTHERS = {"others": True}
"""Metadata of a field dict[str, object] that holds the keys which the dataclass does not name."""


@dataclasses.dataclass(frozen=True)
class Range:
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


def to_json(value: object) -> Json:
    """A dataclass, or lists and dicts of dataclasses, as plain JSON."""
    if dataclasses.is_dataclass(value):
        plain: dict[str, Json] = {}
        for field in dataclasses.fields(value):
            each = getattr(value, field.name)
            if field.metadata == OTHERS:
                plain.update(each)
            elif each is not None or field.metadata != OMITTED:
                plain[field.name] = to_json(each)
        return plain
    if isinstance(value, enum.Enum):
        return value.name.lower()
    if isinstance(value, Mapping):
        return {str(key): to_json(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(each) for each in value]
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"value must be plain or a dataclass; got {type(value).__name__}")


def from_json(kind: type[T], value: object) -> T:
    """A dataclass from plain JSON.

    Raises:
      Misfit: the value is not what the type hints ask for.
    """
    made = _reader(kind)(value)
    assert isinstance(made, kind)
    return made


@functools.cache
def _reader(hint: object) -> Read:
    """The function that reads the values of a type hint."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is object:
        return lambda value: value
    if origin is Annotated:
        return _in_range(_reader(args[0]), *(mark for mark in args[1:] if isinstance(mark, Range)))
    if origin in (typing.Union, types.UnionType):
        (other,) = (arg for arg in args if arg is not types.NoneType)
        read = _reader(other)
        return lambda value: None if value is None else read(value)
    if origin is typing.Literal:
        one_of = ", ".join(map(repr, args))
        return _checked(lambda value: isinstance(value, str) and value in args, f"one of {one_of}")
    if origin is list:
        return _list(_reader(args[0]))
    if origin is tuple:
        read = _list(*map(_reader, args))
        return lambda value: tuple(typing.cast(list, read(value)))
    if origin is dict:
        return _dict(_reader(args[1]))
    assert isinstance(hint, type), hint
    if dataclasses.is_dataclass(hint):
        return _dataclass(hint)
    if issubclass(hint, enum.Enum):
        return _enumeration(hint)
    if hint is float:
        return _float
    return _checked(lambda value: type(value) is hint, f"of type {hint.__name__}")


def _checked(accepts: Callable[[object], bool], required: str) -> Read:
    def read(value: object) -> object:
        if not accepts(value):
            raise Misfit(required, value)
        return value

    return read


def _float(value: object) -> float:
    try:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    except OverflowError:
        pass
    raise Misfit("a number", value)


def _in_range(read: Read, bounds: Range) -> Read:
    def read_in_range(value: object) -> object:
        number = read(value)
        assert isinstance(number, int | float)
        if not bounds.low <= number < bounds.high:
            raise Misfit(f"at least {bounds.low:g} and less than {bounds.high:g}", value)
        return number

    return read_in_range


def _enumeration(kind: type[enum.Enum]) -> Read:
    members = {name.lower(): member for name, member in kind.__members__.items()}

    def read(value: object) -> object:
        if not isinstance(value, str) or value not in members:
            raise Misfit("one of " + ", ".join(map(repr, members)), value)
        return members[value]

    return read


def _inside(read: Read, key: object, value: object) -> object:
    """Read a part of a value; an error says where the part is."""
    try:
        return read(value)
    except Misfit as misfit:
        misfit.path.append(str(key))
        raise


def _list(*each: Read) -> Read:
    """A list of any length for one reader, else a list with one item for each reader."""

    def read(value: object) -> object:
        if not isinstance(value, list):
            raise Misfit("a list", value)
        readers = each * len(value) if len(each) == 1 else each
        if len(readers) != len(value):
            raise Misfit(f"a list of {len(each)}", value)
        return [_inside(one, k, item) for k, (one, item) in enumerate(zip(readers, value))]  # noqa: B905

    return read


def _dict(each: Read) -> Read:
    def read(value: object) -> object:
        if not isinstance(value, dict):
            raise Misfit("an object", value)
        return {key: _inside(each, key, item) for key, item in value.items()}

    return read


def _dataclass(kind: "type[DataclassInstance]") -> Read:
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    others = next((name for name, field in fields.items() if field.metadata == OTHERS), None)
    readers = {name: _reader(hints[name]) for name in fields if name != others}
    absent = (dataclasses.MISSING, dataclasses.MISSING)
    required = [n for n in readers if (fields[n].default, fields[n].default_factory) == absent]

    def read(value: object) -> object:
        if not isinstance(value, dict):
            raise Misfit("an object", value)
        missing = next((name for name in required if name not in value), None)
        if missing is not None:
            raise Misfit(f"an object with the key {missing!r}", value)
        made = {n: _inside(one, n, value[n]) for n, one in readers.items() if n in value}
        if others is not None:
            made[others] = {key: each for key, each in value.items() if key not in readers}
        return kind(**made)

    return read
