"""What each command of the command line does; `cli` parses and reports errors.

Heavy modules are imported inside the commands, so that --help is quick.
"""

import dataclasses
import os
import sys
from pathlib import Path
from typing import Literal

import tyro

from jaxsfm.config import BackboneName, Config, Convolutions, Keypoints, Refinement, preset
from jaxsfm.errors import UserError
from jaxsfm.options import LOCAL, USUAL_WEIGHTS, EngineChoice, WeightsChoice

Positional = tyro.conf.Positional
Preset = Literal["paper", "default", "robust"]
ChosenKeypoints = Keypoints | Literal["preset"]
Switch = Literal["preset", "yes", "no"]


def _config(
    name: str,
    max_size: int,
    keypoints: ChosenKeypoints,
    view_graph: Switch = "preset",
    refine: int | None = None,
    convolutions: Convolutions = "float32",
    relocalizer: Path | None = None,
    backbone: BackboneName = "vgg16",
) -> Config:
    try:
        config = dataclasses.replace(
            preset(name), max_size=max_size, convolutions=convolutions, backbone=backbone
        )
        if relocalizer is not None:
            if keypoints not in ("preset", "learned"):
                raise ValueError(
                    f"relocalizer {relocalizer} needs learned keypoints; got {keypoints}"
                )
            keypoints = "learned"
        if keypoints != "preset":
            config = dataclasses.replace(config, keypoints=keypoints)
        if view_graph != "preset":
            config = dataclasses.replace(config, view_graph=view_graph == "yes")
        if refine is not None:
            if refine < 0:
                raise ValueError(f"refine must be at least 0; got {refine}")
            passes = Refinement(passes=refine) if refine else None
            config = dataclasses.replace(config, refinement=passes)
        return config
    except ValueError as error:
        raise UserError(f"--{str(error).replace('_', '-', 1)}") from error


def check_writable(path: Path | None, option: str, suffixes: tuple[str, ...]) -> None:
    """Fail before the work, not after it."""
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{option} {path}: the name must end in {' or '.join(suffixes)}")
    try:
        writable = not path.is_dir() and path.parent.is_dir() and os.access(path.parent, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        raise UserError(f"{option} {path}: cannot be written there")


def reconstruct(
    images: Positional[Path],
    *,
    out: Path,
    preset: Preset = "default",
    intrinsics: str | None = None,
    refine_intrinsics: Literal["auto", "yes", "no"] = "auto",
    pairs: str = "exhaustive",
    retrieval: Literal["gem", "vlad", "netvlad"] = "vlad",
    best_pairs: int | None = None,
    view_graph: Switch = "preset",
    refine: int | None = None,
    max_size: int = 1600,
    keypoints: ChosenKeypoints = "preset",
    network: WeightsChoice = USUAL_WEIGHTS,
    backbone: BackboneName = "vgg16",
    convolutions: Convolutions = "float32",
    mapper: Literal["incremental", "global"] = "incremental",
    seed: int = 0,
    threads: int = -1,
    reference: Path | None = None,
    with_database: Path | None = None,
    with_hloc: tuple[Path, Path] | None = None,
    devices: int | None = None,
    images_at_once: int | None = None,
    pairs_at_once: int | None = None,
    memory_gb: float | None = None,
    engine: EngineChoice = LOCAL,
    keep_features: bool = False,
) -> int:
    """A folder of photos to a COLMAP model.

    For example
        $ jaxsfm reconstruct PHOTOS --out OUT
        $ jaxsfm reconstruct PHOTOS --out OUT --intrinsics K.txt --preset robust

    Args:
      images: Folder with the photos; sub-folders are included.
      out: Folder for the results; a run that was interrupted goes on there.
      preset: paper: the constants of the authors' code. default: octaves, centred descriptors and
        neighbourhood consensus (night, seasons, weather), better planes, view graph, two passes of
        refinement. robust: default, and photos below max-size enlarged up to twice.
      intrinsics: K.txt (3 x 3; centre of the top-left pixel is (0, 0)) or MODEL:p1,p2,.. (a COLMAP
        model, COLMAP's pixels) for all photos; without it one camera per photo.
      refine_intrinsics: Whether mapping refines them; auto: unless they are given.
      pairs: exhaustive; a file with two image names a line; retrieval:K, each photo's K most
        similar ones; sequential:K, its K next ones by name; or several joined by +.
      retrieval: How photos are described for retrieval:K; netvlad needs its --weights.
      best_pairs: Hand on only each image's N pairs with the most inliers.
      view_graph: Hand on only pairs whose rotations agree with stronger ones (scenes that repeat).
      refine: Passes of multi-view keypoint refinement; 0: none; default: the preset's.
      max_size: Longer side of the working images, pixels.
      keypoints: relocalized: by the largest norms, the paper's rule. learned: by learned scores.
        grid: cell centres (for the ablation).
      network: The network's parameters.
      backbone: The network: vgg16, the paper's; alexnet; vgg19 (with --weights).
      convolutions: What the network multiplies; bfloat16 is meant for accelerators.
      mapper: COLMAP's incremental or global mapper.
      seed: Of everything random.
      threads: Of COLMAP's part; 1 makes the model repeatable to the last byte; -1: all.
      reference: Reference poses (Strecha .camera files or a COLMAP model) to evaluate against.
      with_database: COLMAP database of the same photos: its matches are mapped beside ours.
      with_hloc: hloc's features.h5 and matches.h5 of the same photos, likewise.
      devices: How many of JAX's devices to use; default: all.
      images_at_once: Extracted side by side on each device; default: what fits, one on a CPU.
      pairs_at_once: Matched side by side on each device; default: what fits, one on a CPU.
      memory_gb: For the features at hand, on each device; default: half of an accelerator, an
        eighth of a host, at most 1.6. Less makes photos come back more often.
      engine: Where photos and pairs are computed.
      keep_features: Do not delete them in the end (25 MB for a photo of 1536 x 1024): localize and
        extend then need not compute them.
    """
    config = _config(
        preset,
        max_size,
        keypoints,
        view_graph,
        refine,
        convolutions,
        network.relocalizer,
        backbone,
    )
    from jaxsfm.matching.execution import Execution
    from jaxsfm.report.summary import summary_lines
    from jaxsfm.runs.reconstruct import reconstruct_folder
    from jaxsfm.runs.run_options import RunOptions

    try:
        execution = Execution(
            devices=devices,
            images_at_once=images_at_once,
            pairs_at_once=pairs_at_once,
            memory_gb=memory_gb,
        )
    except ValueError as error:
        raise UserError(f"--{str(error).replace('_', '-')}") from error
    options = RunOptions(
        pairs=pairs,
        retrieval=retrieval,
        best_pairs=best_pairs,
        intrinsics=intrinsics,
        network=network,
        refine_intrinsics=refine_intrinsics,
        mapper=mapper,
        seed=seed,
        threads=threads,
        reference=reference,
        with_database=with_database,
        with_hloc=with_hloc,
        execution=execution,
        engine=engine,
        keep_features=keep_features,
        progress=True,
    )
    report = reconstruct_folder(images, out, config=config, options=options)
    print("\n".join(summary_lines(report)))
    if not report.models:
        where = out / "failed" if (out / "sparse").exists() else out
        print(
            f"jaxsfm: no model: see the lost images above and {where / 'report.json'}",
            file=sys.stderr,
        )
        return 1
    return 0


def match(
    image0: Positional[Path],
    image1: Positional[Path],
    *,
    out: Path,
    plot: Path | None = None,
    preset: Preset = "default",
    max_size: int = 1600,
    keypoints: ChosenKeypoints = "preset",
    network: WeightsChoice = USUAL_WEIGHTS,
    backbone: BackboneName = "vgg16",
    convolutions: Convolutions = "float32",
    seed: int = 0,
) -> int:
    """Match two images; writes keypoints, planes and homographies.

    For example
        $ jaxsfm match A.jpg B.jpg --out m.npz --plot m.png

    Args:
      image0: The first image.
      image1: The second image.
      out: File.npz with keypoints0, keypoints1 (n x 2, original pixels, centre of the top-left
        pixel (0, 0)), aligned (n: keypoints1 is sub-pixel), plane (n) and homographies
        (p x 3 x 3, image 0 to image 1).
      plot: Picture of the matches, a colour for each plane.
      preset: See reconstruct.
      max_size: Longer side of the working images, pixels.
      keypoints: See reconstruct.
      network: The network's parameters.
      backbone: See reconstruct.
      convolutions: See reconstruct.
      seed: Of the RANSAC draws.
    """
    config = _config(
        preset,
        max_size,
        keypoints,
        convolutions=convolutions,
        relocalizer=network.relocalizer,
        backbone=backbone,
    )
    check_writable(out, "--out", (".npz",))
    check_writable(plot, "--plot", (".png", ".jpg"))
    import numpy as np

    from jaxsfm.io.atomic import atomic_file
    from jaxsfm.io.images import inspect_image, read_image
    from jaxsfm.io.weights import chosen_weights
    from jaxsfm.matching.extraction import image_features
    from jaxsfm.matching.pair_matching import match_features
    from jaxsfm.runs.run_options import check_seed
    from jaxsfm.sfm.refine.pair_alignment import align

    check_seed(seed)
    files = [inspect_image(path, name=str(path)) for path in (image0, image1)]
    weights = chosen_weights(network, backbone)
    features = [image_features(weights, file, config=config) for file in files]
    result = match_features(features[0], features[1], config=config, seed=seed)
    keypoints1, aligned = align(result, files[0], files[1], config=config)
    result = dataclasses.replace(result, keypoints1=keypoints1.astype(np.float32))
    with atomic_file(out) as file:
        np.savez(
            file,
            keypoints0=result.keypoints0,
            keypoints1=result.keypoints1,
            aligned=aligned,
            plane=result.plane,
            homographies=result.homographies,
        )
    if plot is not None:
        from jaxsfm.report.plot import draw_matches, save_figure

        working = [
            read_image(file, max_size=config.max_size, enlarge=config.enlarge) for file in files
        ]
        figure = draw_matches(
            working[0].rgb,
            working[1].rgb,
            result,
            scale0=np.asarray(working[0].scale),
            scale1=np.asarray(working[1].scale),
        )
        save_figure(figure, plot)
    print(
        f"{result.num_inliers} matches on {len(result.homographies)} planes "
        f"({result.num_tentative} tentative, {aligned.sum()} aligned): {out}"
    )
    return 0
