"""Functions as compiled programs with numpy results.

Without jit every operation of a function is a program of its own for every shape, and so is every
operation on a result that is no numpy array. Compiling them is most of what such a test does.
"""

from collections.abc import Callable

import jax


def compiled(function: Callable, *static: str) -> Callable:
    """The function as one program for each shape of its arguments; results are numpy arrays.

    JAX keeps the programs under the function. A function whose parts are replaced by a test must be
    a new one, such as a lambda.
    """
    program = jax.jit(function, static_argnames=static)
    return lambda *args, **settings: jax.device_get(program(*args, **settings))
