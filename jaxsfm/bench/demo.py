"""The demo: a rendered scene with exact cameras through the whole pipeline, and the verdict."""

import tempfile
from pathlib import Path

from jaxsfm.bench.synthetic import write_scene
from jaxsfm.config import preset
from jaxsfm.errors import UserError
from jaxsfm.report.summary import summary_lines
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions

MAX_POSITION = 0.002
"""Stated mean position error, units (metres) of the room; measured 0.0001."""
MAX_ROTATION_DEG = 0.03
"""Stated mean rotation error; measured 0.004 deg."""


def run_demo(out: Path | None, *, seed: int) -> tuple[list[str], bool]:
    """Render, write, reconstruct, compare; the lines to print and whether it passed.

    Args:
      out: folder for the scene and the results; None makes one under the temporary folder.
      seed: of the scene's noise and of the reconstruction.
    """
    if out is None:
        out = Path(tempfile.mkdtemp(prefix="jaxsfm-demo-"))
    try:
        truth = write_scene(out / "scene", seed=seed)
    except OSError as error:
        raise UserError(f"--out {out}: cannot be written ({error.strerror})") from error
    options = RunOptions(
        intrinsics=str(out / "scene" / "K.txt"),
        reference=out / "scene" / "reference",
        seed=seed,
        progress=True,
    )
    report = reconstruct_folder(
        out / "scene" / "images", out / "run", config=preset("default"), options=options
    )
    result = report.evaluation
    passed = (
        result is not None
        and result.registered == len(truth)
        and result.position.mean <= MAX_POSITION
        and result.rotation_deg.mean <= MAX_ROTATION_DEG
    )
    verdict = (
        f"demo {'passed' if passed else 'FAILED'}: synthetic scene; required {len(truth)} of "
        f"{len(truth)} cameras, mean errors at most {MAX_POSITION} units and "
        f"{MAX_ROTATION_DEG} deg"
    )
    return [*summary_lines(report), f"files            {out}", verdict], passed
