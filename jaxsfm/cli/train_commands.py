"""The command `jaxsfm train` learns a relocalizer from photos."""

import dataclasses
from pathlib import Path
from typing import Literal

import tyro

from jaxsfm.cli.run_commands import check_writable
from jaxsfm.cli.subcommands import named_options
from jaxsfm.errors import UserError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """The photos and the settings of the training."""

    images: Path
    """Folder with the photos; sub-folders are included."""
    out: Path
    """File.safetensors for the learned scores."""
    steps: int = 400
    """Number of steps; four hundred take ten minutes on two cores."""
    batch: int = 8
    """Number of pairs of views in a step."""
    hidden: int = 32
    """Number of hidden units of each level's perceptron."""
    learning_rate: float = 0.01
    """Learning rate at the start; it falls to 0."""
    temperature: float = 0.5
    """Temperature of the random walks in training."""
    peakiness: float = 0.0
    """Weight of the part of the loss that makes the random walks more certain."""
    reference: Path | None = None
    """Reference poses of the photos, as in reconstruct.
    With them, the training also uses real pairs of photos and their epipolar lines."""
    intrinsics: str | None = None
    """The camera of all photos, needed with --reference. It must have no distortion.
    It is given as for reconstruct."""
    weights: Path | None = None
    """File with weights of VGG-16, made by jaxsfm weights convert. Without it: torchvision's."""
    seed: int = 0
    """Seed of all random choices."""


def train(what: tyro.conf.Positional[Literal["relocalizer"]], *, training: Training) -> int:
    """Learn from any photos the scores that choose keypoints.

    For example
        $ jaxsfm train relocalizer --images PHOTOS --out mine.safetensors

    Random homographies and changes of light turn each photo into pairs of views. Every fifth photo
    is held out to measure the progress. If the training is interrupted, the same command continues
    it. Use the result with reconstruct --relocalizer FILE.

    Args:
      what: What to train: relocalizer.
      training: The photos and the settings of the training.
    """
    del what  # there is one thing to train so far
    check_writable(training.out, "--out", (".safetensors",))
    if (training.reference is None) != (training.intrinsics is None):
        raise UserError("--reference and --intrinsics belong together; one is missing")
    from jaxsfm.colmap.given_cameras import parse_intrinsics
    from jaxsfm.colmap.poses import read_poses
    from jaxsfm.io.weights import load_weights
    from jaxsfm.matching.pipeline import open_images
    from jaxsfm.training.objective import Objective
    from jaxsfm.training.posed_pairs import posed_pairs
    from jaxsfm.training.relocalizer import TrainOptions, train_relocalizer

    with named_options():
        options = TrainOptions(
            steps=training.steps,
            batch=training.batch,
            hidden=training.hidden,
            learning_rate=training.learning_rate,
            seed=training.seed,
            objective=Objective(temperature=training.temperature, peakiness=training.peakiness),
        )
    poses = read_poses(training.reference) if training.reference else None
    camera = parse_intrinsics(training.intrinsics) if training.intrinsics else None
    usable, unusable = open_images(training.images, progress=True)
    for why in unusable.values():
        print(f"skipped: {why}")
    network = load_weights(training.weights)
    posed = None
    if poses is not None and camera is not None:
        posed = posed_pairs(
            network,
            usable,
            poses,
            camera,
            view=options.view,
            batch=options.batch,
            seed=options.seed,
        )
        print(f"{len(posed)} pairs of photos with known cameras")
    seconds = train_relocalizer(
        network, usable, training.out, options=options, posed=posed, progress=True, tell=_say
    )
    print(f"{training.out}: {seconds:.0f} s")
    return 0


def _say(line: str) -> None:
    from tqdm import tqdm

    tqdm.write(line)
