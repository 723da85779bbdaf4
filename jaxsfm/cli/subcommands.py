"""Commands and option classes in the form that tyro expects."""

import contextlib
import dataclasses
import functools
import inspect
import operator
import re
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated

import tyro

from jaxsfm.errors import UserError

Command = Callable[..., int]
_WRAPPED = re.compile(r"\n {4,}(?=[^\s$])")
"""Where an argument's description goes on in the next line; lines of examples start with $."""


def unwrapped(command: Command) -> Command:
    """Join the lines of every argument's description, also in the option classes of the command.

    tyro wraps descriptions itself, but keeps some of the line ends that it finds.
    """
    documented: list[Callable[..., object]] = [command]
    for kind in typing.get_type_hints(command).values():
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            documented += kind.__mro__[:-1]
    for each in documented:
        each.__doc__ = _WRAPPED.sub(" ", inspect.cleandoc(each.__doc__ or ""))
    return command


@contextlib.contextmanager
def named_options() -> Iterator[None]:
    """Make a ValueError about a field, which its message starts with, a UserError about the option
    that sets the field."""
    try:
        yield
    except ValueError as error:
        field, _, problem = str(error).partition(" ")
        option = field.rpartition(".")[2].replace("_", "-")
        raise UserError(f"--{option} {problem}") from error


def one_of(commands: Mapping[str, Command]) -> object:
    """The type of a command's argument that is the result of one of several commands."""
    return functools.reduce(
        operator.or_,
        (
            Annotated[object, tyro.conf.subcommand(name, constructor=unwrapped(command))]
            for name, command in commands.items()
        ),
    )
