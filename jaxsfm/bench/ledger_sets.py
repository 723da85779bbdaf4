"""The sets of `bench ledger`: their photos, what is known of them, and how models are judged.

Ordinary sets should give a whole model without a doubt. Ambiguous ones repeat themselves; their
models should be right, or doubted. Hard ones may give less. Half of the rendered scenes are for
choosing by, and results are reported of the other half.
"""

import fnmatch
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from jaxsfm.bench import ordinary, repeated
from jaxsfm.bench.inputs import check_root, choose_sets
from jaxsfm.bench.ledger_photos import (
    DrawnScene,
    SetPhotos,
    as_drawn,
    as_frames,
    as_photos,
    as_photos_with_poses,
    as_phototourism,
    as_strecha,
    as_turned,
)

Kind = Literal["ordinary", "ambiguous", "hard"]
Half = Literal["", "choose", "report"]
Judge = Literal["places", "rotations", "ring"]
DRAWN = 64
"""The number of rendered scenes of a kind."""
ORDINARY_SIZE, REPEATED_SIZE = (400, 300), (320, 240)
"""Width and height of the photos of rendered scenes, pixels."""
STRECHA = ("fountain-P11", "Herz-Jesus-P8", "entry-P10", "castle-P19", "Herz-Jesus-P25")
WITH_POSES, WITHOUT_POSES = ("dtu24", "temple_sparse_ring"), ("sceaux", "brighton_gps")
CASTLE, TURNED = "castle-P19", "Herz-Jesus-P8"
AMBIGUOUS_SIZES, HARD_SIZES = (600, 800), (1000, 1280, 1600)
"""The limits of the longer side of the photos at which the castle is mapped, pixels. At the small
ones its courtyard is taken for its own mirror."""
EVERY, FRAMES = 10, 50
"""Each so-many-th frame of the kitchen, and so many first ones, are sets of their own. The first
frames show the same from nearly one place."""


class LedgerSet(NamedTuple):
    """A set of photos, or a rendered scene."""

    name: str
    kind: Kind
    source: Path
    """The folder that its data are in; of a rendered scene, any folder."""
    how: Callable[[Path, Path], SetPhotos]
    """Finds the photos in `source`, or makes them in a folder of their own."""
    judge: Judge = "places"
    """places: by positions and rotations. rotations: the reference is too rough for positions.
    ring: the photos were taken on a way around something, in the order of their names."""
    positions: bool = True
    """Whether position and rotation errors are of use."""
    max_size: int | None = None
    """The longer side of the working images, pixels; None: the preset's."""
    half: Half = ""
    """Empty for photos that were taken by a camera; a rendered scene has a half."""

    @property
    def real(self) -> bool:
        """Whether the photos were taken by a camera."""
        return not self.half

    def photos(self, home: Path) -> SetPhotos:
        """The photos of the set; `home` is the folder for those that are made.

        Raises:
          UserError: a photo, a camera or a pose cannot be read, or `home` cannot be written.
        """
        return self.how(self.source, home)


def _ordinary_sets(root: Path) -> list[LedgerSet]:
    strecha, kitchen = root / "strecha", root / "kitchen"
    some, first = partial(as_frames, every=EVERY), partial(as_frames, first=FRAMES)
    return [
        *(LedgerSet(name, "ordinary", strecha / name, as_strecha) for name in STRECHA),
        *(LedgerSet(name, "ordinary", root / name, as_frames) for name in WITH_POSES),
        LedgerSet(f"kitchen-every{EVERY}", "ordinary", kitchen, some, judge="rotations"),
        LedgerSet(f"kitchen-first{FRAMES}", "ordinary", kitchen, first, judge="rotations"),
        LedgerSet("kitchen", "ordinary", kitchen, as_frames, judge="rotations"),
        *(LedgerSet(name, "ordinary", root / name, as_photos) for name in WITHOUT_POSES),
        LedgerSet("sacre_coeur", "ordinary", root / "sacre_coeur", as_phototourism),
    ]


def _other_sets(root: Path) -> list[LedgerSet]:
    """Ambiguous and hard sets."""
    statue, strecha = root / "statue", root / "strecha"

    def castle(kind: Kind, size: int) -> LedgerSet:
        folder = strecha / CASTLE
        return LedgerSet(f"castle-{size}", kind, folder, as_strecha, max_size=size)

    return [
        LedgerSet("cup", "ambiguous", root / "cup", as_photos, judge="ring"),
        LedgerSet(
            "statue", "ambiguous", statue, as_photos_with_poses, judge="rotations", positions=False
        ),
        *(castle("ambiguous", size) for size in AMBIGUOUS_SIZES),
        LedgerSet("turned-Herz-Jesus", "hard", strecha / TURNED, as_turned),
        *(castle("hard", size) for size in HARD_SIZES),
    ]


def _drawn_sets(root: Path, kind: Kind) -> list[LedgerSet]:
    """Rendered scenes. Each half has all the sorts of scene."""
    if kind == "ordinary":
        names, write, size = ordinary.SCENES, ordinary.write_ordinary, ORDINARY_SIZE
    else:
        names, write, size = repeated.SCENES, repeated.write_repeated, REPEATED_SIZE
    found = []
    for number in range(DRAWN):
        scene = DrawnScene(write, names[number // 2 % len(names)], number, size)
        half: Half = "report" if number % 2 else "choose"
        name, how = f"{scene.name}-{number:02d}", partial(as_drawn, scene)
        found.append(LedgerSet(name, kind, root, how, half=half))
    return found


def ledger_sets(root: Path) -> dict[str, LedgerSet]:
    """The sets by name: those of photos whose folder is in `root`, and all rendered scenes.

    Raises:
      UserError: there is no such folder.
    """
    check_root(root)
    sets = [*_ordinary_sets(root), *_other_sets(root)]
    sets += [*_drawn_sets(root, "ordinary"), *_drawn_sets(root, "ambiguous")]
    return {each.name: each for each in sets if each.source.is_dir()}


def choose_ledger_sets(root: Path, names: Sequence[str] | None) -> list[LedgerSet]:
    """The sets in `root` that are called `names`, in that order; None stands for all.

    Args:
      names: may be patterns with * and ?.

    Raises:
      UserError: there is no such folder, or no set that a name or a pattern stands for.
    """
    found = ledger_sets(root)
    if names is None:
        return [*found.values()]
    meant = [match for name in names for match in (fnmatch.filter(found, name) or [name])]
    return choose_sets(found, list(dict.fromkeys(meant)), root)
