"""Compiled programs kept between runs: JAX's persistent compilation cache in the user's cache
folder.
Two photos matched with `paper` took 14 s instead of 22 s."""

import os

import platformdirs

LEAST_SECONDS = 0.2
"""Of compiling, for a program to be kept; JAX's own default is one second."""


def keep_compiled() -> None:
    """Keep compiled programs, unless the user has chosen a folder (`JAX_COMPILATION_CACHE_DIR`).

    By JAX's environment variables: to be called before JAX is imported, which takes longer than
    all else that `jaxsfm --help` does.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = platformdirs.user_cache_path("jaxsfm") / "compiled"
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(LEAST_SECONDS)
