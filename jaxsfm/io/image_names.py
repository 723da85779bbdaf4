"""Which names of photos COLMAP can be given."""

import os
import sys


def name_fault(name: str) -> str | None:
    """Why COLMAP cannot be given the name of a file, in words; None if it can."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        try:
            os.fsencode(name).decode("utf-8")
        except UnicodeError:
            return "the file name is not UTF-8, which COLMAP needs"
        return (
            f"Python takes file names for {sys.getfilesystemencoding()}, and this one is UTF-8; "
            "set the environment variable PYTHONUTF8=1"
        )
    return None
