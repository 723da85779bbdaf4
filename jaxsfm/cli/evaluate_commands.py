"""The commands that compare a model with known poses: `jaxsfm evaluate` and `jaxsfm demo`."""

from json import dumps
from pathlib import Path

import tyro

from jaxsfm.cli.run_commands import check_writable

Positional = tyro.conf.Positional


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
      reference: The folder of Strecha .camera files or of a COLMAP model.
      align_on: A text file with names of photos, one on each line. The model is fitted to the
        reference with these photos only, as the paper does for night photos.
      json: File.json to write, with all errors.
    """
    check_writable(json, "--json", (".json",))
    from jaxsfm.colmap.poses import find_model, model_poses, read_model, read_poses
    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.report.run_results import EvaluationReport
    from jaxsfm.report.summary import evaluation_lines
    from jaxsfm.report.typed_json import from_json, to_json
    from jaxsfm.sfm import evaluation

    truth = read_poses(reference)
    names = evaluation.read_names(align_on) if align_on else None
    poses = model_poses(read_model(find_model(out)))
    errors = evaluation.evaluate(poses, truth, align_on=names)
    result = from_json(EvaluationReport, errors.as_dict())
    for name, error in result.images.items():
        print(f"{name!s:40s} {error.position:10.4f} {error.rotation_deg:9.4f} deg")
    for name in result.missing:
        print(f"{name!s:40s} not in the model")
    print("\n".join(evaluation_lines(result)))
    if json is not None:
        write_atomic(json, dumps(to_json(result), indent=1).encode())
    return 0


def demo(*, out: Path | None = None, seed: int = 0) -> int:
    """Render a small scene, reconstruct it, and compare the result with the exact cameras.

    The exit status is 1 if a camera is missing, or if the mean errors are larger than the last line
    allows.

    Args:
      out: The folder for the scene and the results. Without it, a new folder in the system's
        temporary folder.
      seed: The seed of the scene's noise and of the reconstruction.
    """
    from jaxsfm.bench.demo import run_demo

    lines, passed = run_demo(out, seed=seed)
    print("\n".join(lines))
    return 0 if passed else 1
