"""The exception for whatever a user can correct."""


class UserError(Exception):
    """A file or an option that the user gave cannot be used.

    The text is one sentence that names the file or option. The command line prints it and exits
    with status 2.
    """
