"""Public data sets of the benchmarks: their addresses, sizes and terms, and how to fetch them."""

import dataclasses
import json
import os
from pathlib import Path, PurePosixPath

import msgspec
import platformdirs

from jaxsfm.errors import UserError
from jaxsfm.io.atomic import sha256_of, write_atomic
from jaxsfm.io.download import download, progress_bar, unpack

_STRECHA = (
    "https://raw.githubusercontent.com/openMVG/SfM_quality_evaluation/"
    "e2772f8163e7a945f87557949c7d3afd520b7351/Benchmarking_Camera_Calibration_2008/"
)
"""A fixed commit of openMVG's repository, whose content cannot change."""
_STRECHA_SETS = {
    "Herz-Jesus-P8": 8,
    "Herz-Jesus-P25": 25,
    "castle-P19": 19,
    "castle-P30": 30,
    "entry-P10": 10,
    "fountain-P11": 11,
}
_AACHEN = "https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/Aachen-Day-Night/"
_AACHEN_IMAGES = "images/database_and_query_images.zip"
_AACHEN_PAIRS = (
    "https://raw.githubusercontent.com/tsattler/visuallocalizationbenchmark/"
    "fcdf4b33f3af73e0bd8b240308332b3bc8a27480/local_feature_evaluation/data/aachen-day-night/"
    "image_pairs_to_match_v1_1.txt"
)


@dataclasses.dataclass(frozen=True)
class RemoteFile:
    """One file of a data set."""

    url: str
    name: str
    """The file's path in the data set's folder."""
    known_hash: str | None = None
    """The published hash; None if there is none."""
    archive: bool = False
    """Whether the file is unpacked into the data set's folder and then removed."""


@dataclasses.dataclass(frozen=True)
class DataSet:
    """A data set that a benchmark reads."""

    title: str
    page: str
    terms: str
    size: str
    files: tuple[RemoteFile, ...]
    root: str
    """The folder to give to `--root`, relative to the data set's folder."""
    expects: tuple[str, ...]
    """Paths in the data set's folder that exist if the data set is complete."""
    bench: str
    """The benchmarks that read it."""


def _strecha_files() -> tuple[RemoteFile, ...]:
    names = []
    for folder, count in _STRECHA_SETS.items():
        names.append(f"{folder}/images/K.txt")
        for k in range(count):
            names += [
                f"{folder}/images/{k:04d}.jpg",
                f"{folder}/gt_dense_cameras/{k:04d}.jpg.camera",
            ]
    return tuple(RemoteFile(_STRECHA + name, name) for name in names)


DATA_SETS: dict[str, DataSet] = {
    "strecha": DataSet(
        "Multi-view stereo sets with laser-scanned ground truth (Strecha et al., CVPR 2008), "
        "103 photos of 3072 x 2048",
        "https://github.com/openMVG/SfM_quality_evaluation",
        "research; cite Strecha et al. 2008",
        "0.3 GB (about)",
        _strecha_files(),
        ".",
        tuple(
            f"{name}/{part}" for name in _STRECHA_SETS for part in ("images", "gt_dense_cameras")
        ),
        "strecha, daynight, ambiguous",
    ),
    "aachen": DataSet(
        "Aachen Day-Night 1.1: localization by day and night (Sattler et al., CVPR 2018)",
        "https://www.visuallocalization.net/datasets",
        "non-commercial research; CC BY-NC-SA 4.0",
        "7 GB (about)",
        (
            RemoteFile(_AACHEN + _AACHEN_IMAGES, Path(_AACHEN_IMAGES).name, archive=True),
            RemoteFile(_AACHEN + "aachen_v1_1.zip", "aachen_v1_1.zip", archive=True),
            RemoteFile(_AACHEN_PAIRS, "image_pairs_to_match.txt"),
        ),
        ".",
        ("images_upright", "3D-models", "image_pairs_to_match.txt"),
        "daynight",
    ),
    "wxbs": DataSet(
        "WxBS 1.1: pairs under changes of viewpoint, light, season and sensor (Mishkin et al., "
        "BMVC 2015)",
        "http://cmp.felk.cvut.cz/wbs",
        "none stated; cite Mishkin et al. 2015",
        "40 MB (about)",
        (
            RemoteFile(
                "http://cmp.felk.cvut.cz/wbs/datasets/WxBS_v1.1.zip",
                "WxBS_v1.1.zip",
                "md5:66da037e7d20487e86db147307615870",
                archive=True,
            ),
        ),
        "v1.1",
        ("v1.1",),
        "wxbs",
    ),
}
_FETCHED = "fetched.json"
"""A file in the data set's folder with the hashes of all files that were fetched."""


def data_folder() -> Path:
    """The folder of all data sets: $JAXSFM_DATA, or the user's data folder."""
    own = os.environ.get("JAXSFM_DATA")
    return Path(own) if own else platformdirs.user_data_path("jaxsfm") / "data"


def find(name: str) -> DataSet:
    """The data set called `name`.

    Raises:
      UserError: there is none; the sentence lists the known names.
    """
    if name not in DATA_SETS:
        raise UserError(f"no data set '{name}'; there are {', '.join(DATA_SETS)}")
    return DATA_SETS[name]


def is_complete(name: str, folder: Path | None = None) -> bool:
    """Whether a data set is there and whole: fetched to the end, or put there by the user."""
    home, data_set = (folder or data_folder()) / name, find(name)
    fetched = _read_fetched(home / _FETCHED)
    if fetched is not None and not all(file.name in fetched for file in data_set.files):
        return False
    return all((home / path).exists() for path in data_set.expects)


def path_of(name: str, folder: Path | None = None) -> Path:
    """The folder to give to `--root`.

    Raises:
      UserError: the data set is not there, or not whole.
    """
    home = (folder or data_folder()) / name
    if not is_complete(name, folder):
        raise UserError(f"{home}: not there, or not all of it: jaxsfm data fetch {name}")
    return home / PurePosixPath(find(name).root)


def fetch(name: str, folder: Path | None = None, *, progress: bool = False) -> Path:
    """Download the missing files of a data set; returns the folder to give to `--root`.

    An interrupted download continues where it stopped.

    Raises:
      UserError: a file cannot be downloaded, written or unpacked, or its hash is not the published
        one.
    """
    if is_complete(name, folder):
        return path_of(name, folder)
    home, files = (folder or data_folder()) / name, find(name).files
    fetched = _read_fetched(home / _FETCHED) or {}
    try:
        home.mkdir(parents=True, exist_ok=True)
        write_atomic(home / _FETCHED, _text(fetched))
    except OSError as error:
        raise UserError(f"{home}: cannot be written ({error.strerror or error})") from error
    for k, file in enumerate(files):
        if file.name in fetched:
            continue
        path = home / file.name
        with progress_bar(f"{path.name} ({k + 1} of {len(files)})", shown=progress) as on_bytes:
            download(file.url, path, known_hash=file.known_hash, on_bytes=on_bytes)
        fetched[file.name] = sha256_of(path)
        if file.archive:
            try:
                unpack(path, home)
            except UserError:
                path.unlink()  # so that the same command downloads it again
                raise
        write_atomic(home / _FETCHED, _text(fetched))
        if file.archive:
            path.unlink()
    return path_of(name, folder)


def _text(fetched: dict[str, str]) -> bytes:
    return json.dumps(fetched, indent=1).encode()


def _read_fetched(path: Path) -> dict[str, str] | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, str])
    except FileNotFoundError:
        return None
    except msgspec.ValidationError as error:
        raise UserError(f"{path}: not a list of hashes; remove it to fetch anew") from error
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: not readable ({error}); remove it to fetch anew") from error
