"""The libraries of a process: their versions, their threads, and the programs that JAX keeps.

This module imports none of them, because some of it must be said before they start. Compiled
programs are kept between runs in JAX's persistent compilation cache, in the user's cache folder.
With it, matching two photos with the preset `paper` took 14 s instead of 22 s.
"""

import contextlib
import importlib
import importlib.metadata
import logging
import os
import platform
import sys
import zlib
from pathlib import Path

import platformdirs
import psutil

logger = logging.getLogger("jaxsfm")

PACKAGES = (
    "jaxsfm",
    "jax",
    "jaxlib",
    "flax",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "pycolmap",
)
READ_ONCE = {
    "jax": "NPROC",
    "numpy": "OPENBLAS_NUM_THREADS",
    "pycolmap": "OMP_NUM_THREADS",
    "cv2": "OPENCV_FOR_THREADS_NUM",
}
"""Library -> the variable that says how many threads it may have. The library reads it once,
when it starts."""
LEAST_SECONDS = 0.2
"""Programs that took longer than this to compile are kept; JAX's own default is one second."""
_CHECKED, _ENTRIES = ".checked", "*-cache"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide a result, by name.

    This does not import the packages.
    """
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:  # for example another build of OpenCV
            found[name] = "not known"
    return found


def versions() -> dict[str, str]:
    """Return `package_versions`, the operating system and the devices of JAX, by name."""
    import jax

    devices = jax.devices()
    return {
        **package_versions(),
        "system": f"{platform.system()} {platform.machine()}",
        "devices": f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})",
    }


def limit_threads(count: int) -> None:
    """Let JAX, NumPy, OpenCV and OpenMP use `count` threads; -1 changes nothing.

    This must be called before the libraries are imported. One that has been imported is left alone,
    because its threads may exist already, and other threads may be using them. COLMAP's own threads
    are options of its calls.
    """
    if count < 1:
        return
    for library, variable in READ_ONCE.items():
        if library not in sys.modules:
            os.environ[variable] = str(count)


def usable_cores() -> int:
    """The number of cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def total_memory() -> int:
    """The memory that this process may use, bytes.

    This is the total and not what is free at the moment, because a result must not depend on other
    processes.
    """
    total = psutil.virtual_memory().total
    try:
        total = min(total, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    except (OSError, ValueError):  # there is no limit ("max"), or the system is not Linux
        pass
    return total


def keep_compiled() -> None:
    """Keep compiled programs, unless the user has chosen a folder (`JAX_COMPILATION_CACHE_DIR`).

    This sets environment variables that JAX reads when it is imported, so it must be called before.
    Importing JAX to set its options would take longer than all else that `jaxsfm --help` does.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = platformdirs.user_cache_path("jaxsfm") / "compiled"
        if not _can_write(folder):  # JAX would warn of each program, in several lines
            _refused[:] = [folder]
            return
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(LEAST_SECONDS)
        with contextlib.suppress(OSError):  # the folder is missing or not ours; JAX handles both
            drop_cut_short(folder)


_refused: list[Path] = []
"""The folder for compiled programs, if it cannot be written and this has not been said yet."""


def _can_write(folder: Path) -> bool:
    """Whether a folder can be written or made, as far as permissions tell. Nothing is made."""
    try:
        there = next(path for path in (folder, *folder.parents) if path.exists())
    except OSError:
        return False
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def announce_compilation() -> None:
    """Say that a first run takes longer, if no compiled program is kept yet, or that each does."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR", "")
    if folder and not any(Path(folder).glob(_ENTRIES)):
        logger.info(
            "the first run compiles its programs, which takes about half a minute; "
            "they are kept in %s",
            folder,
        )
    while _refused:
        logger.warning(
            "each run compiles its programs, which takes about half a minute: they cannot be kept "
            "in %s; JAX_COMPILATION_CACHE_DIR names another folder",
            _refused.pop(),
        )


def drop_cut_short(folder: Path) -> int:
    """Delete the entries of the cache that were not written to their end; return their number.

    JAX writes an entry in place and never overwrites one. If a kill or a full disk cut an entry
    short, every later run would warn about it and compile the program again. Entries that are older
    than the last call are known to be whole.
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
            # JAX compresses with this package if it is installed. If it has been removed since,
            # JAX cannot use the entry, and it may stay.
            importlib.import_module("zstandard").ZstdDecompressor().decompress(entry)
        else:
            zlib.decompress(entry)
    except ImportError:
        return True
    except Exception:  # zlib.error, or zstandard's own
        return False
    return True
