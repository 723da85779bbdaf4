"""Public weights: downloaded, compared with a published hash, converted.

Listed are only files whose full hash is published; README.md says where each comes from.
"""

from pathlib import Path
from typing import NamedTuple

import platformdirs
import pooch
import requests

from jaxsfm.errors import UserError
from weights_conversion.convert import read_source, write_converted
from weights_conversion.source import Family

TIMEOUT_S = 30.0
"""For the server to say anything."""
CHUNK = 1 << 20


class Public(NamedTuple):
    """A public file."""

    url: str
    known_hash: str
    """algorithm:digest."""
    family: Family
    megabytes: int
    licence: str


KERAS = "https://github.com/fchollet/deep-learning-models/releases/download/v0.1"
VGG_LICENCE = "Creative Commons Attribution (VGG, University of Oxford)"
PUBLIC: dict[str, Public] = {
    "torchvision": Public(
        "https://download.pytorch.org/models/vgg16-397923af.pth",
        "sha256:397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
        "torchvision",
        553,
        "BSD 3-Clause (torchvision)",
    ),
    "keras": Public(
        f"{KERAS}/vgg16_weights_tf_dim_ordering_tf_kernels_notop.h5",
        "md5:6d6bbae143d832006294945121d1f1fc",
        "keras",
        59,
        VGG_LICENCE,
    ),
    "keras-top": Public(
        f"{KERAS}/vgg16_weights_tf_dim_ordering_tf_kernels.h5",
        "md5:64373286793e3c8b2b4e3219cbf3544b",
        "keras",
        553,
        VGG_LICENCE,
    ),
    "caffe": Public(
        "https://www.vlfeat.org/matconvnet/models/imagenet-vgg-verydeep-16.mat",
        "md5:f72d927587ca4c97fbd165ec9cb9997f",
        "caffe",
        553,
        VGG_LICENCE,
    ),
}


def public_lines() -> list[str]:
    """What there is, as text."""
    lines = []
    for name, file in PUBLIC.items():
        lines += [
            f"{name:12s} about {file.megabytes} MB, {file.licence}",
            f"{'':12s} {file.url}",
            f"{'':12s} {file.known_hash}",
        ]
    return lines


def default_folder() -> Path:
    """Where fetched weights are kept."""
    return platformdirs.user_data_path("jaxsfm") / "weights"


def fetch_weights(name: str, *, out: Path | None = None, progress: bool = False) -> Path:
    """Download one of `PUBLIC`, unless it is there already, and convert it.

    The download is kept in the user's cache folder, so that a conversion can be verified.

    Args:
      out: the converted file; None: NAME.safetensors in `default_folder`.

    Raises:
      UserError: no such name, no connection, not the known file, or it cannot be written.
    """
    if name not in PUBLIC:
        raise UserError(f"no public weights {name!r}; there are {', '.join(PUBLIC)}")
    target = out or default_folder() / f"{name}.safetensors"
    downloaded = download(
        PUBLIC[name], platformdirs.user_cache_path("jaxsfm") / "downloads", progress=progress
    )
    source = read_source(downloaded, family=PUBLIC[name].family)
    _make(target.parent)
    write_converted(source, target)
    return target


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({error.strerror})") from error


def download(file: Public, folder: Path, *, progress: bool = False) -> Path:
    """A public file in a folder, whole and with the known hash; kept from an earlier time if so.

    Raises:
      UserError: it cannot be had or written, or is not the known file.
    """
    _make(folder)
    name = file.url.rpartition("/")[2]
    loader = pooch.HTTPDownloader(progressbar=progress, chunk_size=CHUNK, timeout=TIMEOUT_S)
    pooch.get_logger().setLevel("WARNING")
    try:
        return Path(
            pooch.retrieve(
                file.url,
                known_hash=file.known_hash,
                fname=name,
                path=folder,
                downloader=loader,  # pyright: ignore[reportArgumentType]  pooch's own
            )
        )
    except requests.exceptions.RequestException as error:
        raise UserError(
            f"{file.url}: cannot be downloaded ({_reason(error)}); 'jaxsfm weights convert' takes "
            "a file that was fetched elsewhere"
        ) from error
    except ValueError as error:  # pooch's, with what was expected
        raise UserError(
            f"{file.url}: what came is not the known file (wrong hash, {file.known_hash} is "
            "expected); nothing of it was kept"
        ) from error
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror})") from error


def _reason(error: requests.exceptions.RequestException) -> str:
    """In a few words: the innermost cause says most."""
    if error.response is not None:
        return f"the server answers {error.response.status_code} {error.response.reason}"
    if isinstance(error, requests.exceptions.Timeout):
        return "the server does not answer"
    if isinstance(error, requests.exceptions.ConnectionError):
        return "no connection"
    return "the connection broke"
