"""`jaxsfm pairs`: the pairs of photos that `--pairs` selects, written to a file."""

from pathlib import Path

import tyro

from jaxsfm.cli.run_commands import check_writable
from jaxsfm.config import BackboneName
from jaxsfm.errors import UserError
from jaxsfm.options import Retrieval, WeightsChoice


def pairs(
    images: tyro.conf.Positional[Path],
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
    from jaxsfm.io.weights import chosen_weights
    from jaxsfm.matching.pipeline import open_images
    from jaxsfm.matching.retrieval import describe_photos, partner_pairs

    usable, skipped = open_images(images, progress=True)
    names = [image.name for image in usable]
    selection = parse_pair_selection(chosen_pairs(pairs, len(names)))
    if len(names) < 2:
        raise UserError(f"{images}: {len(names)} usable images, at least 2 are needed")
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
