"""The exception for whatever a user can correct."""

import contextlib
from collections.abc import Iterator


class UserError(Exception):
    """A file or an option that the user gave cannot be used.

    The text is one sentence that names the file or option. The command line prints it and exits
    with status 2.
    """


@contextlib.contextmanager
def writing(what: object) -> Iterator[None]:
    """Report an OSError of the block as a UserError that `what`, a file or folder, names."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what}: cannot be written ({error.strerror or error})") from error
