"""How many threads the libraries of a command use.

Most have an environment variable of their own, which they read once. JAX has no option for it.
"""

import importlib
import os
import sys

READ_ONCE = {
    "jax": "NPROC",
    "numpy": "OPENBLAS_NUM_THREADS",
    "pycolmap": "OMP_NUM_THREADS",
}
"""Library -> the variable that says how many threads it may have."""


def limit_threads(count: int) -> None:
    """Let JAX, NumPy, OpenCV and OpenMP use `count` threads; -1 changes nothing.

    This must be called before the libraries are imported. One that has been imported is left alone,
    because its threads may exist already. COLMAP's own threads are options of its calls.
    """
    if count < 1:
        return
    for library, variable in READ_ONCE.items():
        if library not in sys.modules:
            os.environ[variable] = str(count)
    cv2 = importlib.import_module("cv2")  # only now, because it imports NumPy
    cv2.setNumThreads(count)


def usable_cores() -> int:
    """The number of cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
