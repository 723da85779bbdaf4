"""The weights of the networks. They are checked before use, and nothing in their files is executed.

The default weights (VGG-16, AlexNet; `jaxsfm.io.known_weights`) are pickles of numpy arrays. A
pickle can run code. So the file is opened only after its SHA-256 has been compared, and the
unpickler admits nothing but the three names that a numpy array needs. Other weights are safetensors
files (`jaxsfm.io.weight_files`).
"""

import dataclasses
import functools
import hashlib
import io
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from jaxsfm.config import BackboneName, Config
from jaxsfm.core.features import BACKBONES
from jaxsfm.core.vgg import Preprocessing
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.known_weights import DISTRIBUTION, KNOWN, VERSION, VGG16, find_weights
from jaxsfm.io.relocalizer import Relocalizer, load_relocalizer, shipped_relocalizer
from jaxsfm.io.weight_files import Parameters, is_converted, preprocessing_numbers, read_converted
from jaxsfm.options import WeightsChoice

TORCHVISION = Preprocessing(scale=255.0, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
"""The mean and deviation of ImageNet's images, RGB in [0, 1], as torchvision's models expect."""

WALKED_LAYERS = ("conv1_1", "conv1_2", "conv2_1", "conv2_2")
"""The layers below pool2. The scores of a relocalizer depend on these layers alone."""
SEEN_BY = {VGG16: "2795f754af7da55460f9821d49a5d71843ab606d69bbf1a1d5742fb448884570"}
"""SHA-256 of a weights file -> `Weights.walked`, for relocalizers that recorded only the file."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weights:
    """The parameters of a network, and how they are to be used."""

    backbone: BackboneName = "vgg16"
    params: Parameters
    """{'params': {layer: {'kernel': float32 HWIO, 'bias': float32 O}}}."""
    family: str
    """The framework that trained them (`jaxsfm.io.weight_files.FAMILIES`)."""
    preprocessing: Preprocessing
    """What must be done with an image before the network sees it."""
    source: str
    """Where they come from: a distribution and its version, or the file that was converted."""
    sha256: str
    path: Path
    """The file that was read."""
    about: Mapping[str, Json] = dataclasses.field(default_factory=dict)
    relocalizer: Relocalizer | None = None
    """The scores for learned keypoints; None takes those that come with jaxsfm."""

    @functools.cached_property
    def walked(self) -> str:
        """The SHA-256 of what a relocalizer depends on: the preprocessing and `WALKED_LAYERS`.

        It is computed from the numbers, so it does not depend on the file they come from.
        """
        numbers = np.asarray(preprocessing_numbers(self.preprocessing), np.float64)
        digest = hashlib.sha256(numbers.tobytes())
        for layer in WALKED_LAYERS:
            for part in ("kernel", "bias"):
                array = np.asarray(self.params["params"][layer][part], np.float32)
                digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @property
    def learned(self) -> Relocalizer:
        """The relocalizer for learned keypoints.

        Raises:
          UserError: there is none for this network, or it was trained on other weights, whose
            channels have other meanings.
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
        """The relocalizer that the config needs; None if its keypoints are not learned."""
        return self.learned if config.keypoints == "learned" else None

    def scores(self, config: Config) -> Parameters | None:
        """The parameters of the relocalizer that the config needs, or None."""
        chosen = self.chosen_relocalizer(config)
        return chosen and chosen.params

    def described(self, config: Config) -> dict[str, str | None]:
        """What a report says about the weights and the relocalizer that the config needs."""
        chosen = self.chosen_relocalizer(config)
        return {
            "backbone": self.backbone,
            "family": self.family,
            "source": self.source,
            "sha256": self.sha256,
            "relocalizer_sha256": chosen and chosen.sha256,
        }


class _ArrayUnpickler(pickle.Unpickler):
    """Admits the names that numpy arrays need; any other is refused before it is looked up."""

    def find_class(self, module: str, name: str) -> object:
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "_reconstruct":
            return np._core.multiarray._reconstruct  # pyright: ignore[reportAttributeAccessIssue]
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a weights file")


def read_arrays(data: bytes, *, path: str) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Unpickle nested containers of numpy arrays; UserError for damage and for anything else."""
    try:
        return _ArrayUnpickler(io.BytesIO(data)).load()
    except Exception as error:  # a damaged pickle can raise almost anything
        why = "it needs more memory than there is" if isinstance(error, MemoryError) else error
        raise UserError(f"{path}: not a readable weights file ({why})") from error


def load_weights(
    path: Path | None = None,
    *,
    backbone: BackboneName = "vgg16",
    relocalizer: Path | None = None,
) -> Weights:
    """Load the weights of a network: torchvision's, or converted ones.

    Args:
      path: a file that `jaxsfm weights convert` wrote, or a copy of the known file; None finds the
        known file, and downloads it if this machine has none (`jaxsfm.io.known_weights`).
      relocalizer: a file of learned scores for keypoints; None takes those that come with jaxsfm.

    Raises:
      UserError: the file is missing or damaged, cannot be downloaded, or holds something else or
        the weights of another network.
    """
    if path is not None and is_converted(path):
        loaded = _converted(path)
        if loaded.backbone != backbone:
            raise UserError(
                f"{path}: holds weights of {loaded.backbone}, but --backbone is {backbone}"
            )
    else:
        loaded = _known(path, backbone)
    if relocalizer is None:
        return loaded
    return dataclasses.replace(loaded, relocalizer=load_relocalizer(relocalizer))


def chosen_weights(choice: WeightsChoice, backbone: BackboneName = "vgg16") -> Weights:
    """The weights that a command's options --weights and --relocalizer name (`load_weights`)."""
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


def _known(given: Path | None, backbone: BackboneName) -> Weights:
    path, data = (given, _read_known(given, backbone)) if given else find_weights(backbone)
    # The hash is right, so the arrays are the known ones: their names and shapes need no check.
    tree = read_arrays(data, path=str(path))[KNOWN[backbone].network]
    layers = {
        layer: {
            part: np.asarray(tree[f"Conv_{i}"][part], np.float32) for part in ("kernel", "bias")
        }
        for i, layer in enumerate(BACKBONES[backbone].kernels)
    }
    return Weights(
        backbone=backbone,
        params={"params": layers},
        family="torchvision",
        preprocessing=TORCHVISION,
        source=f"{DISTRIBUTION} {VERSION}",
        sha256=KNOWN[backbone].sha256,
        path=path,
    )


def _read_known(path: Path, backbone: BackboneName) -> bytes:
    """The content of a file that a user gives, whose hash must be the known one."""
    if backbone not in KNOWN:
        raise UserError(f"{path}: holds no weights of {backbone} that are known")
    advice = "'jaxsfm weights convert' makes files of weights"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot read the weights ({error.strerror}); {advice}") from error
    digest = hashlib.sha256(data).hexdigest()
    if digest != KNOWN[backbone].sha256:
        raise UserError(
            f"{path}: holds neither the known weights nor converted ones, or is damaged (SHA-256 "
            f"{digest[:12]}..., {len(data)} bytes); {advice}"
        )
    return data
