"""The demo: reconstruct a rendered scene and compare the result with its exact cameras."""

import tempfile
from pathlib import Path

from jaxsfm.bench.synthetic import write_scene
from jaxsfm.config import preset
from jaxsfm.errors import UserError
from jaxsfm.io.entries import PAGE
from jaxsfm.report.summary import summary_lines
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions

MAX_POSITION = 0.002
"""The largest mean position error that passes, in metres of the room; measured: 0.0001."""
MAX_ROTATION_DEG = 0.03
"""The largest mean rotation error that passes; measured: 0.008 degrees."""


def run_demo(out: Path | None, *, seed: int) -> tuple[list[str], bool]:
    """Run the demo; returns the lines to print and whether it passed.

    Args:
      out: folder for the scene and the results; None makes one in the temporary folder.
      seed: seed of the scene's noise and of the reconstruction.

    Raises:
      UserError: `out` cannot be written.
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
    where = f"where to look    {out / 'run' / PAGE}, in a browser; all files are in {out}"
    return [*summary_lines(report), where, verdict], passed
