"""Downloads public weights, compares them with their published hash, and converts them.

Only files whose full hash is published are listed. README.md says where each of them comes from.
"""

from pathlib import Path
from typing import NamedTuple

import platformdirs

from jaxsfm.errors import UserError
from jaxsfm.io.download import download, progress_bar
from jaxsfm.weights_conversion.convert import read_source, write_converted
from jaxsfm.weights_conversion.source import Family


class PublicWeights(NamedTuple):
    """A public file of weights."""

    url: str
    known_hash: str
    """The published hash, as algorithm:digest."""
    family: Family
    megabytes: int
    licence: str


KERAS = "https://github.com/fchollet/deep-learning-models/releases/download/v0.1"
VGG_LICENCE = "Creative Commons Attribution (VGG, University of Oxford)"
PUBLIC: dict[str, PublicWeights] = {
    "torchvision": PublicWeights(
        "https://download.pytorch.org/models/vgg16-397923af.pth",
        "sha256:397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
        "torchvision",
        553,
        "BSD 3-Clause (torchvision)",
    ),
    "keras": PublicWeights(
        f"{KERAS}/vgg16_weights_tf_dim_ordering_tf_kernels_notop.h5",
        "md5:6d6bbae143d832006294945121d1f1fc",
        "keras",
        59,
        VGG_LICENCE,
    ),
    "keras-top": PublicWeights(
        f"{KERAS}/vgg16_weights_tf_dim_ordering_tf_kernels.h5",
        "md5:64373286793e3c8b2b4e3219cbf3544b",
        "keras",
        553,
        VGG_LICENCE,
    ),
    "caffe": PublicWeights(
        "https://www.vlfeat.org/matconvnet/models/imagenet-vgg-verydeep-16.mat",
        "md5:f72d927587ca4c97fbd165ec9cb9997f",
        "caffe",
        553,
        VGG_LICENCE,
    ),
}


def public_lines() -> list[str]:
    """Return the list of public weights as lines of text."""
    lines = []
    for name, file in PUBLIC.items():
        lines += [
            f"{name:12s} about {file.megabytes} MB, {file.licence}",
            f"{'':12s} {file.url}",
            f"{'':12s} {file.known_hash}",
        ]
    return lines


def default_folder() -> Path:
    """Return the folder in which fetched weights are kept."""
    return platformdirs.user_data_path("jaxsfm") / "weights"


def fetch_weights(name: str, *, out: Path | None = None, progress: bool = False) -> Path:
    """Download one of `PUBLIC`, unless it has been downloaded before, and convert it.

    The download is kept in the user's cache folder, so that the conversion can be verified. An
    interrupted download goes on where it stopped.

    Args:
      name: a key of `PUBLIC`.
      out: the converted file; None takes NAME.safetensors in `default_folder`.
      progress: shows a bar.

    Returns: the converted file.

    Raises:
      UserError: there are no weights of this name, the file cannot be downloaded or has another
        hash, or the result cannot be written.
    """
    if name not in PUBLIC:
        raise UserError(f"no public weights {name!r}; there are {', '.join(PUBLIC)}")
    file, target = PUBLIC[name], out or default_folder() / f"{name}.safetensors"
    place = platformdirs.user_cache_path("jaxsfm") / "downloads" / file.url.rpartition("/")[2]
    with progress_bar(place.name, shown=progress) as on_bytes:
        download(file.url, place, known_hash=file.known_hash, on_bytes=on_bytes)
    source = read_source(place, family=file.family)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{target.parent}: cannot be created ({error.strerror})") from error
    write_converted(source, target)
    return target
