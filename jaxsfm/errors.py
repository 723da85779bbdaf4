"""The one exception whose text is meant for a user: one sentence that names the file or option."""


class UserError(Exception):
    """Something the user gave cannot be used; the CLI prints the text and exits with 2."""
