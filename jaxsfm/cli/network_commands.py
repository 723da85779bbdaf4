"""The commands `jaxsfm weights` and `jaxsfm train`: the parameters of the networks."""

import dataclasses
from pathlib import Path
from typing import Literal

from jaxsfm.cli.arguments import Positional, check_writable, named_options, one_of
from jaxsfm.config import BackboneName
from jaxsfm.errors import UserError
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice

Family = Literal["auto", "torchvision", "keras", "caffe", "netvlad"]
Kernels = Literal["auto", "tensorflow", "theano"]


def show(*, backbone: BackboneName = "vgg16", network: WeightsChoice = USUAL_WEIGHTS) -> int:
    """Check the weights and the relocalizer, and show where they come from.

    Args:
      backbone: The network.
      network: Which files the parameters are read from.
    """
    from jaxsfm.io.weights import chosen_weights

    loaded = chosen_weights(network, backbone)
    p = loaded.preprocessing
    print(f"weights          {loaded.backbone}, {loaded.source}")
    print(f"file             {loaded.path}")
    print(f"family           {loaded.family}")
    print(f"preprocessing    RGB / {p.scale:g}, minus {p.mean}, divided by {p.std}")
    print(f"sha256           {loaded.sha256} (checked)")
    for name in ("source_sha256", "converter", "jaxsfm"):
        if name in loaded.about:
            print(f"  {name:14s} {loaded.about[name]}")
    try:
        learned = loaded.learned
    except UserError as error:
        print(f"relocalizer      none: {error}")
        return 0
    print(f"relocalizer      {network.relocalizer or 'of jaxsfm'}, for learned keypoints")
    print(f"sha256           {learned.sha256}")
    for name, value in learned.about.items():
        if name != "history":
            print(f"  {name:14s} {value}")
    return 0


def convert(
    source: Positional[Path],
    target: Positional[Path],
    *,
    family: Family = "auto",
    kernels: Kernels = "auto",
) -> int:
    """Convert weights of VGG-16 from another framework into a file for --weights.

    torchvision's VGG-19 can be converted too.

    For example
        $ jaxsfm weights convert vgg16.h5 vgg16.safetensors

    Args:
      source: The file to convert: torchvision's vgg16 (.pth, .safetensors), Keras' VGG16 (.h5),
        MatConvNet's imagenet-vgg-verydeep-16.mat or NetVLAD's .mat. Nothing in it is executed.
      target: File.safetensors for the converted weights.
      family: The framework that the file must come from. auto accepts any framework.
      kernels: Only for Keras' files. theano: the kernels are turned by 180 degrees. tensorflow:
        they are not. auto: the file says which.
    """
    check_writable(target, "TARGET", (".safetensors",))
    from jaxsfm.weights_conversion.convert import read_source, write_converted

    found = read_source(source, family=family, kernels=kernels)
    write_converted(found, target)
    for note in found.notes:
        print(f"note             {note}")
    other = "" if found.architecture == "vgg16" else f" --backbone {found.architecture}"
    print(f"{target}: {found.family}, use it with --weights {target}{other}")
    return 0


def verify(
    source: Positional[Path],
    target: Positional[Path],
    *,
    family: Family = "auto",
    kernels: Kernels = "auto",
    size: int = 80,
) -> int:
    """Compare converted weights with their source, layer by layer.

    An independent network, written in numpy and float64, runs the source file with the conventions
    of its framework. The exit status is 1 if the results differ.

    Args:
      source: The file that was converted.
      target: The converted file.
      family: The framework that the source must come from. auto accepts any framework.
      kernels: For Keras' files: theano or tensorflow, as in convert.
      size: Longer side of the image that both networks see, pixels.
    """
    if not 40 <= size <= 2048:  # the shorter side is four fifths of it, and pool5 1/32 of that
        raise UserError(f"--size must lie in 40 .. 2048; got {size}")
    from jaxsfm.weights_conversion.convert import read_source
    from jaxsfm.weights_conversion.verify import agrees, compare, table_lines

    found = read_source(source, family=family, kernels=kernels)
    rows = compare(found, target, size=(size * 4 // 5, size))
    print("\n".join(table_lines(rows)))
    return 0 if agrees(rows) else 1


def fetch(name: Positional[str] = "list", *, out: Path | None = None) -> int:
    """Download public weights, check their hash, and convert them.

    Args:
      name: Name of the weights. The name list prints all names.
      out: File.safetensors for the converted weights. Without it, NAME.safetensors in the user's
        data folder.
    """
    check_writable(out, "--out", (".safetensors",))
    from jaxsfm.weights_conversion.fetch import fetch_weights, public_lines

    if name == "list":
        print("\n".join(public_lines()))
        return 0
    path = fetch_weights(name, out=out, progress=True)
    print(f"{path}: use it with --weights {path}")
    return 0


ACTIONS = {"show": show, "convert": convert, "verify": verify, "fetch": fetch}
_Action = one_of(ACTIONS)


def weights(result: _Action) -> int:  # pyright: ignore[reportInvalidTypeForm]
    """Show, convert, verify or fetch weights. Without an action, jaxsfm weights shows them."""
    return result


def with_action(argv: list[str]) -> list[str]:
    """Insert the action `show` if the command line names no action of `jaxsfm weights`."""
    if argv[:1] != ["weights"] or (len(argv) > 1 and argv[1] in (*ACTIONS, "-h", "--help")):
        return argv
    if len(argv) > 1 and not argv[1].startswith("-"):
        return argv  # tyro reports a misspelt action
    return ["weights", "show", *argv[1:]]


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


def train(what: Positional[Literal["relocalizer"]], *, training: Training) -> int:
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
    from jaxsfm.training.photos import posed_pairs
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
