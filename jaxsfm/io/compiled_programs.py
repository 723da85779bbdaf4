"""Compiled programs kept between runs: JAX's persistent compilation cache in the user's cache
folder.
Two photos matched with `paper` took 14 s instead of 22 s.
"""

import contextlib
import importlib
import os
import zlib
from pathlib import Path

import platformdirs

LEAST_SECONDS = 0.2
"""Of compiling, for a program to be kept; JAX's own default is one second."""
_CHECKED, _ENTRIES = ".checked", "*-cache"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"


def keep_compiled() -> None:
    """Keep compiled programs, unless the user has chosen a folder (`JAX_COMPILATION_CACHE_DIR`).

    By JAX's environment variables: to be called before JAX is imported, which takes longer than
    all else that `jaxsfm --help` does.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = platformdirs.user_cache_path("jaxsfm") / "compiled"
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(LEAST_SECONDS)
        with contextlib.suppress(OSError):  # another's folder, or none: JAX deals with it
            drop_cut_short(folder)


def drop_cut_short(folder: Path) -> int:
    """Delete entries that were not written to their end; their number.

    JAX writes an entry in place and never over another: of one that a kill or a full disk cut
    short, every later run would warn, and compile. Entries older than the last look are whole.
    """
    seen = folder / _CHECKED
    since = seen.stat().st_mtime_ns if seen.exists() else 0
    new = [each for each in folder.glob(_ENTRIES) if each.stat().st_mtime_ns >= since]
    cut = [each for each in new if not _whole(each.read_bytes())]
    for entry in cut:
        entry.unlink(missing_ok=True)
    if new:
        seen.touch()
    return len(cut)


def _whole(entry: bytes) -> bool:
    try:
        if entry[: len(_ZSTANDARD)] == _ZSTANDARD:
            # What JAX compresses with where it is installed; if it is gone, so is the entry's use.
            importlib.import_module("zstandard").ZstdDecompressor().decompress(entry)
        else:
            zlib.decompress(entry)
    except ImportError:
        return True
    except Exception:  # zlib.error, or zstandard's own
        return False
    return True
