"""The commands `jaxsfm refine` and `jaxsfm merge`, which work on COLMAP models of any tool."""

import sys
from pathlib import Path
from typing import Literal

from jaxsfm.cli.run_commands import Positional
from jaxsfm.cli.subcommands import named_options
from jaxsfm.io.libraries import limit_threads
from jaxsfm.options import check_threads


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
