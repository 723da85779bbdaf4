"""The command `pairs`: which pairs of photos `--pairs` means, written to a file."""

from pathlib import Path
from typing import Literal

import tyro

from jaxsfm.commands import check_writable
from jaxsfm.config import BackboneName
from jaxsfm.errors import UserError
from jaxsfm.weights_choice import USUAL_WEIGHTS, WeightsChoice


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
    from jaxsfm.host.atomic import write_atomic
    from jaxsfm.host.plan import planned_pairs, read_plan
    from jaxsfm.host.weights import chosen_weights
    from jaxsfm.pipeline import open_images
    from jaxsfm.retrieval import shortlist

    plan = read_plan(pairs)
    usable, skipped = open_images(images, progress=True)
    names = [image.name for image in usable]
    found = set(planned_pairs(plan, names, [*names, *skipped]))
    if plan.retrieval:
        weights = chosen_weights(network, backbone)
        found.update(shortlist(weights, usable, k=plan.retrieval, kind=retrieval))
    for name in sorted({name for pair in found for name in pair}):
        if name != name.strip() or name.startswith("#") or "\t" in name or "\n" in name:
            raise UserError(f"--out {out}: {name!r} cannot be written in such a file; rename it")
    lines = (f"{a}\t{b}\n" if " " in a + b else f"{a} {b}\n" for a, b in sorted(found))
    write_atomic(out, "".join(lines).encode())
    print(f"{len(found)} pairs of {len(names)} photos: {out}")
    return 0
