"""The commands that start from photos: reconstruct, frames, match, pairs and demo.

Heavy modules are imported inside the commands, so that --help is quick.
"""

import dataclasses
from pathlib import Path

from jaxsfm.cli.arguments import (
    MatchingChoice,
    ModelChoice,
    Positional,
    check_writable,
    named_options,
)
from jaxsfm.config import BackboneName
from jaxsfm.errors import UserError
from jaxsfm.io.extras import require
from jaxsfm.io.libraries import limit_threads
from jaxsfm.options import (
    EngineChoice,
    ExecutionChoice,
    ReconstructionChoice,
    Retrieval,
    WeightsChoice,
    check_seed,
)

DOUBTFUL = 3
"""The exit status for a model that may be wrong."""


def reconstruct(
    images: Positional[Path],
    *,
    out: Path,
    config: ModelChoice,
    run: ReconstructionChoice,
    network: WeightsChoice,
    execution: ExecutionChoice,
    engine: EngineChoice,
) -> int:
    """Build a COLMAP model from a folder of photos, or from a video.

    For example
        $ jaxsfm reconstruct PHOTOS --out OUT
        $ jaxsfm reconstruct PHOTOS --out OUT --intrinsics K.txt --preset robust
        $ jaxsfm reconstruct PHOTOS --out OUT --cameras single --camera-model OPENCV
        $ jaxsfm reconstruct PHOTOS --out OUT --masks MASKS
        $ jaxsfm reconstruct PHOTOS --out OUT --rig rig_config.json
        $ jaxsfm reconstruct PHOTOS --out OUT --georeference gcp_list.txt
        $ jaxsfm reconstruct PHOTOS --out OUT --panorama yes --nadir 55
        $ jaxsfm reconstruct VIDEO.mp4 --out OUT

    The exit status is 0 for a model, 1 if no model could be built, and 3 for a model that may be
    wrong: its verdict, in the summary and in the report, is amber or red.

    Args:
      images: Folder with the photos; sub-folders are included. If it is a video file, frames are
        chosen and kept in OUT/frames, as jaxsfm frames chooses them.
      out: Folder for the results. If a run there was interrupted, the same command continues it.
    """
    chosen = config.config(network.relocalizer)
    limit_threads(run.threads)
    from jaxsfm.io.entries import FAILED
    from jaxsfm.matching.execution import Execution
    from jaxsfm.report.closing import closing_lines
    from jaxsfm.report.summary import summary_lines
    from jaxsfm.runs.reconstruct import reconstruct_folder, reconstruct_video
    from jaxsfm.runs.run_options import RunOptions

    with named_options():
        checked = Execution(**vars(execution))
    options = RunOptions(
        **vars(run), network=network, execution=checked, engine=engine, progress=True
    )
    work = reconstruct_video if images.is_file() else reconstruct_folder
    report = work(images, out, config=chosen, options=options)
    failed = not report.models and (out / "sparse").exists()  # beside an earlier model
    ending = closing_lines(report, out / FAILED if failed else out)
    print("\n".join([*summary_lines(report), "", *ending]))
    if not report.models:
        return 1
    return DOUBTFUL if report.verdict in ("amber", "red") else 0


def match(
    image0: Positional[Path],
    image1: Positional[Path],
    *,
    out: Path,
    plot: Path | None = None,
    mask0: Path | None = None,
    mask1: Path | None = None,
    seed: int = 0,
    matching: MatchingChoice,
    network: WeightsChoice,
) -> int:
    """Match two photos, and write the matches and the homographies to a file.

    For example
        $ jaxsfm match A.jpg B.jpg --out m.npz --plot m.png
        $ jaxsfm match A.jpg B.jpg --out m.npz --mask0 A.jpg.png

    Args:
      image0: The first photo.
      image1: The second photo.
      out: File.npz to write. keypoints0 and keypoints1 (n x 2) are the matches, in pixels of the
        original images; the centre of the top-left pixel is (0, 0). aligned (n) says whether
        keypoints1 is accurate to a fraction of a pixel. plane (n) is the index of the match's
        homography. homographies (p x 3 x 3) map the first image to the second; a surface of a hard
        pair can have several. confidence is the probability that the photos show the same and that
        most matches are right.
      plot: File.png or File.jpg to write: a picture of the matches, with one colour for each plane.
      mask0: Image of the size of the first photo, whose black pixels are not used.
      mask1: The same for the second photo.
      seed: Seed of all random choices.
    """
    config = matching.config(network.relocalizer)
    check_writable(out, "--out", (".npz",))
    check_writable(plot, "--plot", (".png", ".jpg"))
    if plot is not None:
        require("plots", "--plot needs")
    import numpy as np

    from jaxsfm.io.atomic import atomic_file
    from jaxsfm.io.images import inspect_image, read_image
    from jaxsfm.io.photo_folder import with_mask
    from jaxsfm.io.weights import chosen_weights
    from jaxsfm.matching.extraction import image_features
    from jaxsfm.sfm.two_photos.pair_passes import match_photos

    check_seed(seed)
    files = [
        with_mask(inspect_image(path, name=str(path)), mask)
        for path, mask in ((image0, mask0), (image1, mask1))
    ]
    weights = chosen_weights(network, config.backbone)
    features = [image_features(weights, file, config=config) for file in files]
    found = match_photos(weights, features[0], features[1], config=config, seed=seed)
    aligned = found.aligned.aligned
    keypoints1 = found.aligned.keypoints1.astype(np.float32)
    result = dataclasses.replace(found.result, keypoints1=keypoints1)
    with atomic_file(out) as file:
        np.savez(
            file,
            keypoints0=result.keypoints0,
            keypoints1=result.keypoints1,
            aligned=aligned,
            plane=result.plane,
            homographies=result.homographies,
            confidence=found.confidence,
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
        f"({aligned.sum()} aligned), confidence {100 * found.confidence:.0f} %, after "
        f"{'one pass' if found.passes == 1 else f'{found.passes} passes'}: {out}"
    )
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


def frames(
    video: Positional[Path],
    *,
    out: Path,
    overlap: float = 0.8,
    most: int | None = None,
) -> int:
    """Choose frames of a video: the sharpest one of each stretch of the camera's way.

    For example
        $ jaxsfm frames VIDEO.mp4 --out FRAMES
        $ jaxsfm frames VIDEO.mp4 --out FRAMES --overlap 0.9 --most 200
        $ jaxsfm reconstruct FRAMES --out OUT --pairs retrieval:20+sequential:6

    Args:
      video: The video file.
      out: A new or empty folder for the frames. Their names have the number of the frame in the
        video.
      overlap: The part of its view that a chosen frame has in common with the one before it, from
        0.2 to 0.98. More overlap gives more frames.
      most: The largest number of frames. If there are more, frames at equal steps of the camera's
        way are kept, with less overlap.
    """
    from jaxsfm.io.entries import named_place
    from jaxsfm.runs.video.frames import FrameOptions, frames_folder

    options = FrameOptions(overlap=overlap, most=most)
    found = frames_folder(video, named_place(out), options, progress=True)
    before = ", chosen before" if found.there else ""
    print(
        f"{len(found.names)} frames: {out} (neighbours have about {100 * found.common:.0f} % in "
        f"common{before})"
    )
    return 0


def pairs(
    images: Positional[Path],
    *,
    out: Path,
    pairs: str = "retrieval:20",
    retrieval: Retrieval = "vlad",
    backbone: BackboneName = "vgg16",
    network: WeightsChoice,
) -> int:
    """Write the pairs that reconstruct would try to a file. reconstruct --pairs FILE reads it.

    For example
        $ jaxsfm pairs PHOTOS --out pairs.txt --pairs retrieval:20

    Args:
      images: Folder with the photos; sub-folders are included.
      out: File.txt to write, with two image names on each line.
      pairs: Which pairs are written. The values are those of --pairs in jaxsfm reconstruct --help.
      retrieval: How a photo is described by one vector for retrieval:K. netvlad needs NetVLAD's
        weights, given with --weights.
      backbone: The network that describes the photos.
    """
    check_writable(out, "--out", (".txt",))
    from tqdm import tqdm

    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.io.pair_selection import chosen_pairs, parse_pair_selection, selected_pairs
    from jaxsfm.io.photo_folder import too_few
    from jaxsfm.io.weights import chosen_weights
    from jaxsfm.matching.pipeline import open_images
    from jaxsfm.matching.retrieval import describe_photos, partner_pairs

    usable, skipped = open_images(images, progress=True)
    names = [image.name for image in usable]
    selection = parse_pair_selection(chosen_pairs(pairs, len(names)))
    if len(names) < 2:
        raise UserError(too_few(images, len(names), skipped))
    found = set(selected_pairs(selection, names, [*names, *skipped]))
    if selection.retrieval:
        weights = chosen_weights(network, backbone)
        with tqdm(total=len(usable), desc="retrieval", unit="image") as bar:
            alone = describe_photos(weights, usable, kind=retrieval, on_image=bar.update)
        found.update(partner_pairs(alone.vectors, selection.retrieval))
        skipped |= {image.name: str(error) for image, error in alone.lost}
        found = {pair for pair in found if not skipped.keys() & set(pair)}
    for why in skipped.values():
        print(f"skipped          {why}")
    if not found:
        raise UserError(f"{images}: there are no pairs to try")
    for name in sorted({name for pair in found for name in pair}):
        if name != name.strip() or name.startswith("#") or "\t" in name or "\n" in name:
            raise UserError(f"--out {out}: {name!r} cannot be written in such a file; rename it")
    lines = (f"{a}\t{b}\n" if " " in a + b else f"{a} {b}\n" for a, b in sorted(found))
    write_atomic(out, "".join(lines).encode())
    print(f"{len(found)} pairs of {len(names)} photos: {out}")
    return 0
