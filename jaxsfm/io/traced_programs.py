"""Traced programs are kept between runs, beside the compiled ones (`jaxsfm.io.libraries`).

JAX finds a compiled program by the code that it was compiled from. To have this code, each process
traces the Python function and lowers the result. This takes as long as a photo's features, for each
size of photos or of views (docs/decisions/accelerators.md#programs-between-runs).

A traced program is kept as an exported one (`jax.export`). Such a file holds the code of operations
and names of containers, and nothing is unpickled.
"""

import contextlib
import functools
import hashlib
import logging
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Generic, ParamSpec, TypeVar

import jax
import numpy as np
from jax import export
from jax.sharding import Mesh

import jaxsfm.core
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import load_arrays, save_arrays
from jaxsfm.io.libraries import package_versions

P = ParamSpec("P")
T = TypeVar("T")

logger = logging.getLogger("jaxsfm")

FOLDER, ENTRY, CODE = "traced", "{}.safetensors", "code"
"""The folder inside the one of compiled programs, a file in it, and its array."""
_SWITCHES = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
)
"""Settings of JAX that change what a function is traced to, or whether it can be traced."""


class Traced(Generic[P, T]):
    """A jitted function of `jaxsfm.core` whose traced programs are kept.

    It is called as the function is: arrays by position, static arguments by name. The result is the
    same, bit for bit.

    Programs are kept if compiled ones are, and on one CPU only. Whether the programs of several
    devices and of accelerators can be kept in the same way has not been tried. A program that
    cannot be kept is traced as if there was no folder.

    What is changed in the modules of the core after they were imported, as tests do, goes unseen if
    the program has been kept.
    """

    def __init__(self, function: Callable[P, T], *containers: type) -> None:
        """Keep the programs of `function`.

        Args:
          containers: the NamedTuples among its arguments and its result, which files name.
        """
        self._function = function
        self._containers = containers
        self._programs: dict[Hashable, Callable[..., T]] = {}

    def __call__(self, *args: P.args, **static: P.kwargs) -> T:
        """The result of the function."""
        folder = _folder()
        if folder is None:
            return self._function(*args, **static)
        known = (_shapes(args), tuple(sorted(static.items())), _switches())
        if known not in self._programs:
            try:
                self._programs[known] = self._program(folder, args, static)
            except Exception as error:  # whatever it is, the function itself may not have it
                logger.debug("%s: its program is not kept: %s", self._function.__name__, error)
                self._programs[known] = functools.partial(self._function, **static)
        return self._programs[known](*args)

    def _program(self, folder: Path, args: Sequence[object], static: dict) -> Callable[..., T]:
        """The program for such arguments, from its file if there is one."""
        for each in self._containers:
            _name_in_files(each)
        path = folder / ENTRY.format(self._key(args, static))
        kept = load_arrays(path)
        if kept:
            code = kept[CODE].tobytes()
        else:
            function = jax.jit(functools.partial(self._function, **static))
            code = bytes(export.export(function)(*args).serialize())
            # An edit of the core since it was imported is not in this program, but in later ones.
            if code_of_core() == _CODE:
                with contextlib.suppress(UserError):  # the next process traces it again
                    save_arrays(path, {CODE: np.frombuffer(code, np.uint8)})
        exported = export.deserialize(bytearray(code))

        def program(*args: object) -> T:
            return exported.call(*args)  # pyright: ignore[reportReturnType]

        program.__name__ = self._function.__name__  # for JAX's logs and profiles
        return jax.jit(program)

    def _key(self, args: Sequence[object], static: dict) -> str:
        """What fixes a program: its function, the arguments, the code and the packages.

        A mesh is left out, because there is one device.
        """
        settings = {name: x for name, x in sorted(static.items()) if not isinstance(x, Mesh)}
        names = self._function.__module__, self._function.__qualname__
        parts = (*names, repr(_shapes(args)), repr(settings), repr(_switches()), *_made_by())
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _folder() -> Path | None:
    """Where traced programs are kept; None if they are not."""
    config = jax.config
    compiled = config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if not compiled or "://" in compiled or _CODE is None:
        return None
    if config.jax_disable_jit or not config.jax_enable_compilation_cache:  # pyright: ignore
        return None
    one_cpu = jax.default_backend() == "cpu" and jax.local_device_count() == 1
    return Path(compiled) / FOLDER if one_cpu else None


def _shapes(args: Sequence[object]) -> Hashable:
    """The structure of arguments, and the shape and the type of each array."""
    leaves, tree = jax.tree.flatten(args)
    return tree, tuple((np.shape(each), getattr(each, "dtype", type(each))) for each in leaves)


def _switches() -> tuple[object, ...]:
    return tuple(getattr(jax.config, name) for name in _SWITCHES)


def code_of_core() -> str | None:
    """A digest of all modules of the core as they are on the disk; None if they are not there."""
    folder, digest = Path(jaxsfm.core.__path__[0]), hashlib.sha256()
    modules = sorted(folder.rglob("*.py"))
    for path in modules:
        code = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()} {len(code)}\n".encode())
        digest.update(code)
    return digest.hexdigest() if modules else None


_CODE = code_of_core()
"""That of the modules that are imported: they have just been, or will be now."""


@functools.cache
def _made_by() -> tuple[str, ...]:
    """The code of the core, and the packages that trace it."""
    return str(_CODE), *(f"{name} {number}" for name, number in package_versions().items())


@functools.cache
def _name_in_files(container: type) -> None:
    """Say by which name a NamedTuple is found again in a file."""
    name = f"{container.__module__}.{container.__qualname__}"
    export.register_namedtuple_serialization(container, serialized_name=name)
