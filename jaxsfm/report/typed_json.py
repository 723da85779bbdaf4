"""Dataclasses as JSON: how they are written, and types of numbers.

`msgspec.convert` reads them and checks every value. The type hints of a dataclass are its schema. A
key that the dataclass does not name is ignored.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import msgspec

from jaxsfm.io.atomic import Json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

OMITTED = {"omitted": True}
"""Metadata of a field that is left out of the JSON where it is None or an empty dict."""
Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]
"""A number of things."""
Number = Annotated[float, msgspec.Meta(ge=-1e30, lt=1e30)]
"""A finite number, of which sums and products stay finite too."""


def to_json(value: "DataclassInstance") -> dict[str, Json]:
    """A dataclass as plain JSON.

    `msgspec.to_builtins` does not serve here. It leaves out fields that have their default value in
    a dataclass that msgspec has read, and it writes what `functools.cached_property` keeps.
    """
    plain: dict[str, Json] = {}
    for field in dataclasses.fields(value):
        each = getattr(value, field.name)
        if field.metadata != OMITTED or (each is not None and each != {}):
            plain[field.name] = _plain(each)
    return plain


def _plain(value: object) -> Json:
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_json(value)
    raise TypeError(f"value must be plain or a dataclass; got {type(value).__name__}")
