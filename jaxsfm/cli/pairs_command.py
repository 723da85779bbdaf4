"""The command `pairs`: which pairs of photos `--pairs` means, written to a file."""

from pathlib import Path
from typing import Literal

import tyro

from jaxsfm.cli.run_commands import check_writable
from jaxsfm.config import BackboneName
from jaxsfm.errors import UserError
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice


def pairs(
    images: tyro.conf.Positional[Path],
    *,
    out: Path,
    pairs: str = "retrieval:20",
    retrieval: Literal["gem", "vlad", "netvlad"] = "vlad",
    network: WeightsChoice = USUAL_WEIGHTS,
    backbone: BackboneName = "vgg16",
) -> int:
    """The pairs that a run would try, as a file that --pairs takes.

    For example
        $ jaxsfm pairs PHOTOS --out pairs.txt --pairs retrieval:20

    Args:
      images: Folder with the photos; sub-folders are included.
      out: File.txt to write: two names a line.
      pairs: See reconstruct.
      retrieval: See reconstruct.
      network: The network's parameters.
      backbone: See reconstruct.
    """
    check_writable(out, "--out", (".txt",))
    from tqdm import tqdm

    from jaxsfm.io.atomic import write_atomic
    from jaxsfm.io.pair_selection import parse_pair_selection, selected_pairs
    from jaxsfm.io.weights import chosen_weights
    from jaxsfm.matching.pipeline import open_images
    from jaxsfm.matching.retrieval import described_alone, nearest_pairs

    selection = parse_pair_selection(pairs)
    usable, skipped = open_images(images, progress=True)
    names = [image.name for image in usable]
    if len(names) < 2:
        raise UserError(f"{images}: {len(names)} usable images, at least 2 are needed")
    found = set(selected_pairs(selection, names, [*names, *skipped]))
    if selection.retrieval:
        weights = chosen_weights(network, backbone)
        with tqdm(total=len(usable), desc="retrieval", unit="image") as bar:
            alone = described_alone(weights, usable, kind=retrieval, on_image=bar.update)
        found.update(nearest_pairs(alone.vectors, selection.retrieval))
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
