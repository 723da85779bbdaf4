"""Commands as tyro wants them."""

import functools
import operator
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import tyro

Command = Callable[..., Any]
_WRAPPED = re.compile(r"\n {8,}(?=[^\s$])")
"""A line of an argument's description that goes on; examples start with $."""


def unwrapped(command: Command) -> Command:
    """With every argument's description on one line: tyro wraps by itself and keeps our ends."""
    command.__doc__ = _WRAPPED.sub(" ", command.__doc__ or "")
    return command


def one_of(commands: Mapping[str, Command]) -> Any:
    """The type of a command's argument that is the result of one of several commands."""
    return functools.reduce(
        operator.or_,
        (
            Annotated[Any, tyro.conf.subcommand(name, constructor=unwrapped(command))]
            for name, command in commands.items()
        ),
    )
