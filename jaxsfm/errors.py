"""Errors that a user can correct, and questions whose errors harm nothing."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import TypeVar

T = TypeVar("T")
logger = logging.getLogger("jaxsfm")


class UserError(Exception):
    """A file or an option that the user gave cannot be used.

    The text is one sentence that names the file or option. The command line prints it and exits
    with status 2.
    """


@contextlib.contextmanager
def writing(what: object) -> Iterator[None]:
    """Report an OSError of the block as a UserError that `what`, a file or folder, names.

    A broken pipe is not reported: it is that of a progress bar, and no file's.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise UserError(f"{what}: cannot be written ({error.strerror or error})") from error


def remark(what: str, ask: Callable[[], T]) -> T | None:
    """The answer to a question that is asked for a remark only; None if the question fails.

    Such a question must not end a run, whatever is wrong with it. It fails in one line of the log.

    Args:
      what: what is asked, in words that follow "it is not known".
    """
    try:
        return ask()
    except Exception as error:  # noqa: BLE001
        logger.warning("it is not known %s: %s (%s)", what, error, type(error).__name__)
        return None
