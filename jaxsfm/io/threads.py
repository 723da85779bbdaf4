"""How many threads the libraries of a command use.

Each library has an environment variable of its own, which it reads once, when it starts.
"""

import os
import sys

READ_ONCE = {
    "jax": "NPROC",
    "numpy": "OPENBLAS_NUM_THREADS",
    "pycolmap": "OMP_NUM_THREADS",
    "cv2": "OPENCV_FOR_THREADS_NUM",
}
"""Library -> the variable that says how many threads it may have."""


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
