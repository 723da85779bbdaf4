"""`bench turns`: photos and copies of themselves that are turned by quarters and resized.

The place of every pixel in the copy is known. The figure is the share of the matches that lie
within 3 pixels of it.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypedDict

import numpy as np

from jaxsfm.bench.alterations import Alteration, Altered, alter
from jaxsfm.bench.figures import BenchFigures, Cells, Spread, collect, spread, table
from jaxsfm.bench.inputs import choose_sets
from jaxsfm.bench.matches import Matcher, Matches
from jaxsfm.bench.methods import PAIR_METHODS
from jaxsfm.bench.pair_options import TurnsOptions
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.matching.pipeline import open_images
from jaxsfm.sfm.two_photos.common_view import mapped

NEAR_PX = 3.0
"""A match this near to its true place is right, pixels of the photo that is smaller."""


class TurnsRow(TypedDict):
    """The figures of one photo, one copy and one method."""

    photo: str
    quarters: int
    """Quarter turns of the copy to the left."""
    scale: float
    """How much larger things are in the copy."""
    method: str
    matches: Spread
    share: Spread
    """Of the matches, within `NEAR_PX`."""
    seconds: float


Means = dict[str, dict[str, float]]
"""The mean share by method, and by turn and scale."""


class Copies(NamedTuple):
    """A photo and a copy of it, either of them reduced."""

    photo: Altered
    copy: Altered

    def errors(self, found: Matches) -> np.ndarray:
        """How far matches are from their true places, float64 (n,), pixels of the smaller photo."""
        at0 = mapped(self.photo.to_original, found.xy0)
        at1 = mapped(self.copy.to_original, found.xy1)
        return np.linalg.norm(at0 - at1, axis=1) / max(self.photo.pixel, self.copy.pixel)


def copies(rgb: np.ndarray, quarters: int, scale: float) -> Copies:
    """A photo and a turned copy in which things are `scale` times as large: below 1 the copy is
    reduced, above 1 the photo."""
    return Copies(
        alter(rgb, Alteration(scale=min(1.0, 1 / scale))),
        alter(rgb, Alteration(scale=min(1.0, scale), quarters=quarters)),
    )


def bench_turns(options: TurnsOptions) -> BenchFigures[TurnsRow, Means]:
    """Match all photos with all their copies.

    Raises:
      UserError: a photo or an option cannot be used.
    """
    methods = options.chosen_methods(PAIR_METHODS)
    photos = _photos(options)[:: options.every]
    return collect("turns", _rows(photos, methods, options), means, cells, options)


def _photos(options: TurnsOptions) -> list[ImageFile]:
    """The photos in the chosen sub-folders, or all of them."""
    images, _ = open_images(options.root)
    names = options.chosen_sets()
    if names is None:
        return images
    folders: dict[str, list[ImageFile]] = {}
    for image in images:
        folders.setdefault(image.name.rpartition("/")[0], []).append(image)
    return [image for some in choose_sets(folders, names, options.root) for image in some]


def _rows(
    images: Sequence[ImageFile], methods: Sequence[str], options: TurnsOptions
) -> Iterator[TurnsRow]:
    matcher = Matcher(options)
    for image in images:
        rgb = read_image(image, max_size=max(image.size)).rgb
        for scale in options.chosen_scales():
            for quarters in options.chosen_quarters():
                with TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
                    both = copies(rgb, quarters, scale)
                    photo, copy = (
                        each.written(Path(scratch) / f"{name}.png")
                        for name, each in both._asdict().items()
                    )
                    for method in methods:
                        runs = matcher.match(photo, copy, method)
                        yield _row(image.name, quarters, scale, method, both, runs)


def _row(
    name: str, quarters: int, scale: float, method: str, both: Copies, runs: Sequence[Matches]
) -> TurnsRow:
    near = [both.errors(run) <= NEAR_PX for run in runs]
    return {
        "photo": name,
        "quarters": quarters,
        "scale": scale,
        "method": method,
        "matches": spread(map(len, near)),
        "share": spread(float(each.mean()) if len(each) else 0.0 for each in near),
        "seconds": float(np.median([run.seconds for run in runs])),
    }


def _copy_name(row: TurnsRow) -> str:
    return f"turned {90 * row['quarters']}, scale {row['scale']:g}"


def means(rows: Sequence[TurnsRow]) -> Means:
    """The mean share of each method by turn and scale."""
    shares: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        of_method = shares.setdefault(row["method"], {})
        of_method.setdefault(_copy_name(row), []).append(row["share"]["mean"])
    return {
        method: {name: float(np.mean(values)) for name, values in found.items()}
        for method, found in shares.items()
    }


def cells(row: TurnsRow) -> Cells:
    """A row of the table."""
    return {
        "photo": row["photo"],
        "copy": _copy_name(row),
        "method": row["method"],
        "matches": f"{row['matches']['mean']:.0f}",
        f"<= {NEAR_PX:g} px": f"{row['share']['mean']:.3f}",
        "seconds": f"{row['seconds']:.2f}",
    }


def table_lines(result: BenchFigures[TurnsRow, Means]) -> list[str]:
    """A line for each kind of copy, with the mean share of each method."""
    methods = result["summary"]
    names = dict.fromkeys(name for found in methods.values() for name in found)
    return table(
        [
            {"copy": name, **{method: f"{found[name]:.3f}" for method, found in methods.items()}}
            for name in names
        ],
        names=1,
    )
