"""The option `--pairs`: which pairs of photos are matched.

Its value is `exhaustive`, a file, `sequential:K`, `retrieval:K`, or several of these joined by `+`,
which selects the pairs of all of them. `auto` stands for one of these, by the number of photos.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from jaxsfm.errors import UserError
from jaxsfm.io.pairs import Pair, exhaustive_pairs, make_pair, read_pairs

FEW = 40
"""Up to so many photos, `auto` tries all pairs: at most 780, which take three minutes on two cores
in low-resolution matching."""
MANY = "retrieval:20+sequential:3"
"""What `auto` tries of more photos: similar ones, and neighbours by name."""


SHARED = 0.4
"""Frames of a video that share about this part of their views, or more, are matched as neighbours.
Pairs that share less are left to retrieval."""
MOST_NEIGHBOURS = 10


def chosen_pairs(text: str, photos: int, many: str = MANY) -> str:
    """A value of `--pairs` with what `auto` stands for, unless a file of this name exists.

    Args:
      photos: their number.
      many: what `auto` stands for if they are many.
    """
    if text != "auto" or os.path.isfile(text):
        return text
    return "exhaustive" if photos <= FEW else many


def many_frames(common: float) -> str:
    """What `auto` stands for with many frames of a video.

    Retrieval finds the frames of a place to which the camera comes back.

    Args:
      common: the part of a view that neighbouring frames have in common.
    """
    steps = round((1 - SHARED) / max(1 - common, 1e-6))
    return f"retrieval:20+sequential:{min(max(steps, 2), MOST_NEIGHBOURS)}"


class PairSelection(NamedTuple):
    """The parts of a value of `--pairs`."""

    exhaustive: bool = False
    files: tuple[Path, ...] = ()
    """Files that list pairs."""
    sequential: int = 0
    """Each image is paired with this many images that follow it."""
    retrieval: int = 0
    """Each image is paired with this many images that are similar to it."""


def parse_pair_selection(text: str) -> PairSelection:
    """Parse a value of `--pairs`. If a file of this name exists, the value is that file.

    Raises UserError if a part is neither a file nor one of the known words, or its number is wrong.
    """
    parts = [text] if os.path.isfile(text) else text.split("+")
    selection = PairSelection()
    for part in parts:
        kind, colon, number = part.partition(":")
        if os.path.isfile(part):
            selection = selection._replace(files=(*selection.files, Path(part)))
        elif part == "exhaustive":
            selection = selection._replace(exhaustive=True)
        elif colon and kind in ("sequential", "retrieval"):
            count = max(getattr(selection, kind), _count(part, number))
            selection = selection._replace(**{kind: count})
        else:
            raise UserError(
                f"--pairs {text}: {part!r} is neither a file nor exhaustive, sequential:K or "
                "retrieval:K" + "; auto stands alone" * (part == "auto")
            )
    return selection


def _count(part: str, number: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", number) or int(number) < 1:
        raise UserError(f"--pairs {part}: a whole number of at least 1 must follow the colon")
    return int(number)


def natural(name: str) -> tuple[list[str | int], str]:
    """Return a sort key by which the numbers in names count: img2 comes before img10."""
    parts = re.split(r"([0-9]+)", name)
    return [int(p) if k % 2 else p for k, p in enumerate(parts)], name


def sequential_pairs(names: Iterable[str], k: int) -> list[Pair]:
    """Pair each image with the k that follow it in the natural order of names."""
    row = sorted(set(names), key=natural)
    return sorted(make_pair(a, b) for i, a in enumerate(row) for b in row[i + 1 : i + 1 + k])


def selected_pairs(
    selection: PairSelection, names: Iterable[str], known: Iterable[str]
) -> list[Pair]:
    """Return the selected pairs, without those of retrieval, which needs to look at the photos.

    Args:
      names: the images that can be used.
      known: the images that a file may name.

    Raises:
      UserError: a file of pairs cannot be used (`read_pairs`).
    """
    names, known = list(names), list(known)
    pairs = set(exhaustive_pairs(names)) if selection.exhaustive else set()
    for path in selection.files:
        pairs.update(read_pairs(path, known))
    if selection.sequential:
        pairs.update(sequential_pairs(names, selection.sequential))
    return sorted(pairs)
