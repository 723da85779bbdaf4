"""The commands that take a finished run or a model.

`localize` and `extend` find places for new photos, `refine` and `merge` improve models of any tool,
and `evaluate`, `report` and `view` show what there is.
"""

import sys
from json import dumps
from pathlib import Path
from typing import Literal

from jaxsfm.cli.arguments import Positional, check_writable, named_options
from jaxsfm.errors import UserError
from jaxsfm.io.libraries import limit_threads
from jaxsfm.options import EngineChoice, NewPhotosChoice, WeightsChoice, check_threads


def localize(
    photos: Positional[tuple[Path, ...]],
    *,
    model: Path,
    out: Path | None = None,
    reference: Path | None = None,
    new_photos: NewPhotosChoice,
    network: WeightsChoice,
    engine: EngineChoice,
) -> int:
    """Find where photos were taken, with the models of a finished run, which do not change.

    The exit status is 1 if no photo could be localized.

    For example
        $ jaxsfm localize A.jpg --model OUT --out poses.json

    Args:
      photos: Photos, or folders with photos.
      model: The folder of a finished run.
      out: File.json to write: the poses, the numbers of matches that support them, and their
        expected errors.
      reference: Reference poses of these photos and of the run's photos, as in reconstruct.
        With them, the errors of the poses are printed.
      network: The files of the network's parameters. They must be those of the run.
    """
    check_writable(out, "--out", (".json",))
    limit_threads(new_photos.threads)
    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.runs.localize import localize_photos
    from jaxsfm.runs.localize_report import localize_lines
    from jaxsfm.runs.run_options import LocalizeOptions

    options = LocalizeOptions(
        **vars(new_photos), reference=reference, network=network, engine=engine, progress=True
    )
    result = localize_photos(photos, model, options=options)
    if out is not None:
        write_atomic(out, dumps(result.to_json(), indent=1).encode())
    print("\n".join(localize_lines(result)))
    if not any(row.status == "localized" for row in result.photos):
        print("jaxsfm: no photo could be localized: see above", file=sys.stderr)
        return 1
    return 0


def extend(
    run: Positional[Path],
    *,
    new_photos: NewPhotosChoice,
    network: WeightsChoice,
    engine: EngineChoice,
) -> int:
    """Add photos to the models of a finished run.

    Put the new photos into the folder of the run's photos first. Each gets its place in the model
    that it fits best. Poses and points that are already in the models do not change.

    The exit status is 1 if no new photo found its place.

    For example
        $ jaxsfm extend OUT

    Args:
      run: The folder of a finished run.
      network: The files of the network's parameters. They must be those of the run.
    """
    limit_threads(new_photos.threads)
    from jaxsfm.io.images import shown_name
    from jaxsfm.runs.extend import extend_run
    from jaxsfm.runs.run_options import LocalizeOptions

    options = LocalizeOptions(**vars(new_photos), network=network, engine=engine, progress=True)
    report = extend_run(run, options=options)
    if report is None:
        print(f"no new photos for {run}")
        return 0
    assert report.extended is not None
    last = report.extended[-1]
    registered, without = set(last.registered), set(last.added) - set(last.registered)
    for name in last.skipped:
        print(f"skipped    {report.images.skipped[name]}")
    for photo in report.lost:
        if photo.image in without:
            print(f"lost       {shown_name(photo.image)}: {photo.detail}")
    print(
        f"registered {len(last.registered)} of {len(last.added)} new photos in {last.rounds} rounds"
    )
    for k, model in enumerate(report.models):
        if grown := registered.intersection(model.images):
            print(
                f"sparse/{k}   {len(grown)} new photos: {model.registered} images, "
                f"{model.points} points"
            )
    return 0 if last.registered else 1


def refine(
    model: Positional[Path],
    *,
    images: Path,
    out: Path,
    max_size: int = 1600,
    passes: int = 2,
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto",
    threads: int = -1,
) -> int:
    """Refine a COLMAP model of any tool to a fraction of a pixel.

    Every observation is moved to where the photos agree, wrong ones are dropped, missing ones are
    added, and the cameras are adjusted. The model may come from COLMAP, hloc, nerfstudio, jaxsfm or
    another tool, with any features.

    The exit status is 1 if too little of the model agrees with the photos.

    For example
        $ jaxsfm refine sparse/0 --images PHOTOS --out REFINED

    Args:
      model: Folder of the model, binary or text. It can also be the folder of a run, of hloc's
        results, or of nerfstudio's data.
      images: Folder of the photos that the model was made of.
      out: New folder for the refined model and refine.json.
      max_size: Limit for the longer side of a photo, in pixels. Larger photos are reduced to it.
      passes: How many times observations are aligned and the model is adjusted.
      refine_intrinsics: Whether focal lengths and distortion are refined too. auto: if photos share
        cameras, unless these look calibrated, because their principal points lie beside the centres
        of the photos.
      threads: Number of threads of COLMAP, JAX and all else; -1 uses all cores. With 1 thread, the
        same command gives the same model, byte for byte.
    """
    check_threads(threads)
    limit_threads(threads)
    from jaxsfm.config import Config, Refinement
    from jaxsfm.runs.refine import RefineOptions, refine_folder, refine_lines

    with named_options():
        config = Config(max_size=max_size, refinement=Refinement(passes=passes))
    options = RefineOptions(
        config=config, refine_intrinsics=refine_intrinsics, threads=threads, progress=True
    )
    report = refine_folder(model, images, out, options=options)
    if report is None:
        print(
            f"jaxsfm: {model}: not refined, because too few of its points look alike in the photos "
            f"of {images}; are they the photos that the model was made of?",
            file=sys.stderr,
        )
        return 1
    print("\n".join([*refine_lines(report), f"refined model: {out}"]))
    return 0


def merge(
    first: Positional[Path],
    second: Positional[Path],
    *,
    out: Path,
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto",
    threads: int = -1,
) -> int:
    """Join two COLMAP models that share photos.

    The second model is moved into the frame of the first one, points that both have become one, and
    all is adjusted together. Photos are the same if their names are. The models must share at least
    two photos and the keypoints in them, so both need the same features.

    For example
        $ jaxsfm merge A B --out BOTH

    Args:
      first: Folder of a model, binary or text, or of a run.
      second: Folder of the other one.
      out: New folder for the joined model and merge.json.
      refine_intrinsics: Whether focal lengths and distortion are adjusted too. auto: unless the
        cameras of both models look calibrated.
      threads: Number of threads of COLMAP and all else; -1 uses all cores. With 1 thread, the same
        command gives the same model, byte for byte.
    """
    check_threads(threads)
    limit_threads(threads)
    from jaxsfm.runs.merge import merge_folders, merge_lines

    report = merge_folders(first, second, out, refine_intrinsics=refine_intrinsics, threads=threads)
    print("\n".join([*merge_lines(report), f"joined model: {out}"]))
    return 0


def evaluate(
    out: Positional[Path],
    *,
    reference: Path,
    align_on: Path | None = None,
    json: Path | None = None,
) -> int:
    """Compare the cameras of a model with reference poses.

    The model is first moved, turned and scaled to fit the reference best.

    For example
        $ jaxsfm evaluate OUT --reference POSES

    Args:
      out: The folder of a run or of a COLMAP model.
      reference: The folder of the reference poses, as in reconstruct.
      align_on: A text file with names of photos, one on each line. The model is fitted to the
        reference with these photos only, as the paper does for night photos.
      json: File.json to write, with all errors.
    """
    check_writable(json, "--json", (".json",))
    from jaxsfm.colmap.model_files import find_model, read_model
    from jaxsfm.colmap.poses import model_poses, read_poses
    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.report.finished_run import evaluation_report
    from jaxsfm.report.summary import evaluation_lines
    from jaxsfm.report.typed_json import to_json
    from jaxsfm.sfm.evaluation import read_names

    truth = read_poses(reference)
    names = read_names(align_on) if align_on else None
    poses = model_poses(read_model(find_model(out)))
    result = evaluation_report(poses, truth, align_on=names)
    for name, error in result.images.items():
        print(f"{name!s:40s} {error.position:10.4f} {error.rotation_deg:9.4f} deg")
    for name in result.missing:
        print(f"{name!s:40s} not in the model")
    print("\n".join(evaluation_lines(result)))
    if json is not None:
        write_atomic(json, dumps(to_json(result), indent=1).encode())
    return 0


def report(
    run: Positional[Path],
    *,
    images: Path | None = None,
    reference: Path | None = None,
    out: Path | None = None,
) -> int:
    """Write the report of a run as one page of HTML.

    reconstruct writes this page by itself. Use this command to write it again, for example with
    photos that have moved or with other reference poses.

    Args:
      run: The folder of a run.
      images: The folder of the photos. Without it, the folder in which the run found them.
      reference: Reference poses, as in reconstruct. Without it, those of the run.
      out: File.html to write. Without it, report.html in the folder of the run.
    """
    check_writable(out, "--out", (".html",))
    from jaxsfm.report.page.write import write_page

    print(write_page(run, images=images, reference=reference, out=out))
    return 0


def view(
    run: Positional[Path],
    *,
    images: Path | None = None,
    reference: Path | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
) -> int:
    """Show the model of a run in the browser, until Ctrl-C.

    Unlike the page that jaxsfm report writes, the viewer shows all points of large models.

    Args:
      run: The folder of a run.
      images: The folder of the photos. Without it, the folder in which the run found them.
      reference: Reference poses, as in reconstruct. Without it, those of the run.
      port: The port of the server. If it is taken, the next free port is used.
      host: The address of the server. With 0.0.0.0, other machines can connect too.
    """
    if not 1 <= port <= 65535:
        raise UserError(f"--port must lie in 1 .. 65535; got {port}")
    from jaxsfm.report.finished_run import read_run
    from jaxsfm.report.viewer import serve

    serve(read_run(run, images=images, reference=reference), host=host, port=port)
    return 0
