"""What `--pairs` says: which pairs are tried.

`exhaustive`, a file, `sequential:K`, `retrieval:K`, or several of them joined by `+`, whose pairs
are united.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from jaxsfm.errors import UserError
from jaxsfm.io.pairs import Pair, exhaustive_pairs, make_pair, read_pairs


class PairSelection(NamedTuple):
    """The parts of `--pairs`."""

    exhaustive: bool = False
    files: tuple[Path, ...] = ()
    sequential: int = 0
    """So many next images of each; 0: none."""
    retrieval: int = 0
    """So many most similar images of each; 0: none."""


def parse_pair_selection(text: str) -> PairSelection:
    """The selection of a value of `--pairs`; a file of that very name comes first.

    Raises:
      UserError: a part is nothing of all that.
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
                "retrieval:K"
            )
    return selection


def _count(part: str, number: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", number) or int(number) < 1:
        raise UserError(f"--pairs {part}: a whole number of at least 1 must follow the colon")
    return int(number)


def natural(name: str) -> tuple[list[str | int], str]:
    """What names are sorted by for numbers to count: img2 before img10."""
    parts = re.split(r"([0-9]+)", name)
    return [int(p) if k % 2 else p for k, p in enumerate(parts)], name


def sequential_pairs(names: Iterable[str], k: int) -> list[Pair]:
    """Each image with its k next ones in the natural order of names."""
    row = sorted(set(names), key=natural)
    return sorted(make_pair(a, b) for i, a in enumerate(row) for b in row[i + 1 : i + 1 + k])


def selected_pairs(
    selection: PairSelection, names: Iterable[str], known: Iterable[str]
) -> list[Pair]:
    """The pairs of a selection that need no photo to be looked at: all but those by retrieval.

    Args:
      names: the images that can be used.
      known: those that a file may name.

    Raises:
      UserError: as `read_pairs`.
    """
    names, known = list(names), list(known)
    pairs = set(exhaustive_pairs(names)) if selection.exhaustive else set()
    for path in selection.files:
        pairs.update(read_pairs(path, known))
    if selection.sequential:
        pairs.update(sequential_pairs(names, selection.sequential))
    return sorted(pairs)
