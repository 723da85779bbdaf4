"""The commands that look at a finished run: `jaxsfm evaluate`, `jaxsfm report`, `jaxsfm view`."""

from json import dumps
from pathlib import Path

from jaxsfm.cli.run_commands import Positional, check_writable
from jaxsfm.errors import UserError


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
    from jaxsfm.colmap.poses import find_model, model_poses, read_model, read_poses
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
