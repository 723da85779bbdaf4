"""The command `jaxsfm export`: the model and the matches of a run in the formats of other tools."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, assert_never

import tyro

from jaxsfm.cli.arguments import check_writable
from jaxsfm.config import MIN_SIDE
from jaxsfm.errors import UserError
from jaxsfm.io.entries import named_place

if TYPE_CHECKING:
    import pycolmap

Format = Literal["hloc", "colmap", "colmap-text", "ply", "nerfstudio", "undistorted"]
GEOREFERENCE = "georeference.json"
"""The file beside an exported model that says where it is: report.json's `georeference`."""


def export(
    run: tyro.conf.Positional[Path],
    *,
    to: Format,
    out: Path,
    images: Path | None = None,
    copy_images: bool = False,
    matches: Literal["all", "verified"] = "all",
    max_size: int | None = None,
) -> int:
    """Write the model or the matches of a run in the format of another tool (docs/formats.md).

    For example
        $ jaxsfm export OUT --to nerfstudio --out NERF --copy-images
        $ jaxsfm export OUT --to hloc --out HLOC
        $ jaxsfm export OUT --to undistorted --out DENSE --max-size 2000

    Args:
      run: The folder of a run. For formats that hold a model, it can also be the folder of a COLMAP
        model.
      to: The format. hloc: features.h5, matches.h5 and pairs.txt. colmap, colmap-text: the model.
        ply: the points of the model. nerfstudio: transforms.json and points. undistorted: photos
        without lens distortion and their model, for dense stereo and Gaussian splatting.
      out: The file (for ply) or the new folder to write.
      images: The folder of the photos, which are undistorted, or to which the file of nerfstudio
        refers. Without it, the folder in which the run found them, if it still exists.
      copy_images: For nerfstudio: copy the photos into a folder named images, next to
        transforms.json.
      matches: Which matches are written for hloc. all: those that were handed to COLMAP. verified:
        those of trusted pairs that COLMAP verified.
      max_size: For undistorted: the longer side of the new photos has at most this many pixels.
        Without it, they are about as large as the photos.
    """
    if max_size is not None and to != "undistorted":
        raise UserError("--max-size: goes with --to undistorted")
    if max_size is not None and max_size < MIN_SIDE:
        raise UserError(f"--max-size {max_size}: must be at least {MIN_SIDE}")
    if copy_images and to != "nerfstudio":
        raise UserError("--copy-images: goes with --to nerfstudio")
    if images is not None and not images.is_dir():
        raise UserError(f"--images {images}: no such folder")
    if not run.is_dir():
        raise UserError(f"{run}: no such folder")
    images = images or _recorded_photos(run)
    if images is None and (copy_images or to == "undistorted"):
        option = "--copy-images" if copy_images else f"--to {to}"
        raise UserError(
            f"{option}: {run} does not say where its photos are; name them with --images"
        )
    with _fresh(out, ".ply" if to == "ply" else None) as fresh:
        if to == "hloc":
            _write_hloc(fresh, run, matches)
        elif to == "nerfstudio":
            _write_nerfstudio(fresh, _model(run), images, copy_images)
        elif to == "undistorted":
            _write_undistorted(fresh, run, images, max_size)
        else:
            _write_model(fresh, _model(run), to)
        if to not in ("ply", "hloc"):
            _write_georeference(fresh, run)
    print(f"{to}: {out}")
    return 0


@contextlib.contextmanager
def _fresh(path: Path, suffix: str | None) -> Iterator[Path]:
    """A new folder to fill, or the place of a new file. It appears at `path` when it is complete,
    or not at all.

    Args:
      suffix: how the file's name must end; None for a folder.

    Raises:
      UserError: there is a file or a non-empty folder already where a folder is wanted, or the
        place cannot be written.
    """
    try:
        if suffix is not None:
            check_writable(path, "--out", (suffix,))
        elif path.exists() and not path.is_dir():
            raise UserError(f"--out {path}: is a file, not a folder")
        elif path.is_dir() and any(path.iterdir()):
            raise UserError(f"--out {path}: not empty; choose an empty or new folder")
        else:
            path = named_place(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = tempfile.TemporaryDirectory(dir=path.parent, prefix=".jaxsfm-")
    except OSError as error:
        raise UserError(f"--out {path}: cannot be written ({error.strerror or error})") from error
    with scratch:
        fresh = Path(scratch.name) / f"export{suffix or ''}"
        if suffix is None:
            fresh.mkdir()
        yield fresh
        if path.is_dir():
            path.rmdir()  # it is empty; Windows puts no folder in the place of another
        os.replace(fresh, path)


def _recorded_photos(run: Path) -> Path | None:
    """The folder in which the run found its photos; None if it is not known or gone."""
    from jaxsfm.report.run_inputs import PhotoFolder
    from jaxsfm.report.run_report import read_part

    try:
        folder = read_part(run, PhotoFolder, "images").folder
    except UserError:  # the folder is not a run's
        return None
    return Path(folder) if folder is not None and Path(folder).is_dir() else None


def _model(run: Path) -> "pycolmap.Reconstruction":
    from jaxsfm.colmap.model_files import find_model, read_model

    return read_model(find_model(run))


def _write_model(
    fresh: Path, model: "pycolmap.Reconstruction", to: Literal["ply", "colmap", "colmap-text"]
) -> None:
    from jaxsfm.colmap.formats.tables import check_no_blanks
    from jaxsfm.colmap.model_files import model_bytes, write_model
    from jaxsfm.io.atomic import check_disk_space

    if to == "colmap":
        write_model(model, fresh)
        return
    if to == "colmap-text":
        check_no_blanks([image.name for image in model.images.values()], to)
    # COLMAP cuts files off and says nothing. A float of 8 bytes has at most 24 letters, a blank.
    check_disk_space(fresh.parent, 25 * model_bytes(model) // 8)
    if to == "ply":
        model.export_PLY(fresh)
    elif to == "colmap-text":
        model.write_text(fresh)
    else:
        assert_never(to)


def _write_georeference(folder: Path, run: Path) -> None:
    """Write where the model is on the Earth beside it, if the run says so."""
    import json

    from jaxsfm.report.run_report import read_part
    from jaxsfm.report.typed_json import to_json
    from jaxsfm.sfm.georeference.georeference import Georeference

    try:
        found = read_part(run, Georeference, "georeference")
    except UserError:  # the folder is not a run's, or the run was not moved
        return
    if found.models and found.models[0].similarity is not None:
        text = json.dumps(to_json(found) | {"models": [to_json(found.models[0])]}, indent=1)
        (folder / GEOREFERENCE).write_text(text, encoding="utf-8")


def _write_hloc(folder: Path, run: Path, matches: Literal["all", "verified"]) -> None:
    from jaxsfm.colmap.formats.database import read_database
    from jaxsfm.colmap.formats.hloc import write_hloc
    from jaxsfm.io.images import working_size
    from jaxsfm.report.finished_run import ORIGINAL
    from jaxsfm.report.run_inputs import RecordedConfig
    from jaxsfm.report.run_report import read_part

    path = run / "database.db"
    if not path.is_file():
        raise UserError(f"{run}: no database.db here, so there are no matches to write for hloc")
    tables = read_database(path, where=str(path))
    try:
        config = read_part(run, RecordedConfig, "options", "config")
        limits = config.max_size, config.enlarge
    except UserError:  # no run of jaxsfm: keypoints are in original pixels
        limits = ORIGINAL
    scales = {s: max(s) / max(working_size(s, *limits)) for s in set(tables.sizes.values())}
    chosen = tables.matches if matches == "all" else tables.inliers
    write_hloc(folder, tables, chosen, {name: scales[s] for name, s in tables.sizes.items()})


def _write_nerfstudio(
    folder: Path, model: "pycolmap.Reconstruction", images: Path | None, copy_images: bool
) -> None:
    from jaxsfm.colmap.formats.nerfstudio import IMAGES, write_nerfstudio
    from jaxsfm.colmap.formats.tables import registered_images

    write_nerfstudio(folder, model, None if copy_images or images is None else images.absolute())
    if not copy_images or images is None:
        return
    for image in registered_images(model):
        source, target = images / image.name, folder / IMAGES / image.name
        if not source.is_file():
            raise UserError(f"--images {images}: no {image.name} in it")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)


def _write_undistorted(folder: Path, run: Path, images: Path | None, max_size: int | None) -> None:
    from jaxsfm.colmap.formats.undistorted import write_undistorted
    from jaxsfm.colmap.model_files import find_model, read_model

    if images is None:
        raise ValueError("undistorted images are made from photos, whose folder is not given")
    found = find_model(run)
    write_undistorted(folder, found, read_model(found), images, max_size or -1)
