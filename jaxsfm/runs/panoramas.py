"""Panoramas in a run: which photos are some, what views they will have, and their poses.

Everything about them is planned and checked before any view is rendered, which
`jaxsfm.runs.view_folder` does.
"""

import dataclasses
import functools
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from jaxsfm.colmap.panorama_poses import panorama_poses, write_panorama_table
from jaxsfm.colmap.poses import model_poses
from jaxsfm.config import MIN_SIDE, Config
from jaxsfm.core.panorama import Direction, ViewSet, panorama_directions
from jaxsfm.errors import UserError
from jaxsfm.io.entries import PANORAMAS
from jaxsfm.io.images import ImageError, ImageFile, named, shown_name
from jaxsfm.io.orientation import UPRIGHT
from jaxsfm.io.pairs import Pair, make_pair
from jaxsfm.io.panoramas import is_equirectangular_size, is_panorama
from jaxsfm.io.position_tables import Measurement
from jaxsfm.io.rig_config import Rig, RigCamera
from jaxsfm.options import PanoramaChoice
from jaxsfm.report.run_results import PlacedPanoramas
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.georeference.georeference import MeasuredPositions

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

VIEW_SET = ViewSet(tuple(Direction(60.0 * k, 0.0) for k in range(6)), 90.0)
"""Which views a panorama has (docs/decisions/panoramas.md). The first one looks to the middle of
the panorama, so its axes are those of the panorama, and of the rig."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PanoramaViews:
    """The views of the panoramas of a run, in a folder with the other photos of the run."""

    folder: Path
    masks: Path | None
    """The folder of their masks and of those of the other photos; None if there are none."""
    view_of: dict[str, tuple[str, int]]
    """The panorama of each view, and which of `VIEW_SET` it is, by the view's name."""
    rig: Rig
    lost: dict[str, str]
    """The panoramas that cannot be read, and why."""

    @property
    def panoramas(self) -> list[str]:
        """Their names."""
        return sorted({name for name, _ in self.view_of.values()})

    def write_poses(
        self, folder: Path, models: Sequence["pycolmap.Reconstruction"]
    ) -> PlacedPanoramas:
        """Write the poses that the panoramas have in models into a table in a folder, and say how
        many have one in the first model."""
        found = [panorama_poses(model_poses(each), VIEW_SET, self.view_of) for each in models]
        write_panorama_table(folder / PANORAMAS, found)
        placed = len({name for poses in found for name in poses})
        logger.info("%d of %d panoramas have a pose (%s)", placed, len(self.panoramas), PANORAMAS)
        return PlacedPanoramas(found=len(self.panoramas), registered=len(found[0]) if found else 0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PanoramaPlan:
    """The panoramas of a run, before any of their views is rendered."""

    panoramas: list[ImageFile]
    others: list[ImageFile]
    """The other photos of the run."""
    side: int
    """Of the views, pixels. All have one size, that for the largest panorama: they are one rig."""
    nadir_deg: float
    """So many degrees around straight down are not used; 0: all is."""

    @functools.cached_property
    def images(self) -> list[ImageFile]:
        """The photos as the run will see them. In the place of each view is its panorama's file."""
        size = (self.side, self.side)
        views = [
            dataclasses.replace(
                image, name=name, size=size, orientation=UPRIGHT, taken_with="", mask=None
            )
            for image in self.panoramas
            for name in views_of(image.name)
        ]
        return sorted([*self.others, *views], key=lambda image: image.name)

    @functools.cached_property
    def panorama_of(self) -> dict[str, str]:
        """The panorama of each view, by the view's name."""
        return {view: each.name for each in self.panoramas for view in views_of(each.name)}

    @property
    def rig(self) -> Rig:
        """That of all views."""
        return panorama_rig(self.side, range(len(VIEW_SET.directions)))

    @property
    def views(self) -> list[ImageFile]:
        """Those of `images` that are views."""
        return [image for image in self.images if image.name in self.panorama_of]

    def measured(self, of_photos: MeasuredPositions) -> MeasuredPositions:
        """What was measured of photos, as that of the photos of the run: the position of a panorama
        is that of its views, and what it shows is measured in the view that looks there."""
        names = {each.name for each in self.panoramas}
        positions = {
            own: at
            for name, at in of_photos.positions.items()
            for own in (views_of(name) if name in names else [name])
        }
        points = [
            dataclasses.replace(
                point, seen=[own for each in point.seen if (own := self._in_view(each))]
            )
            for point in of_photos.points
        ]
        return dataclasses.replace(of_photos, positions=positions, points=points)

    def _in_view(self, measured: Measurement) -> Measurement | None:
        """A measurement, if in a panorama, in its view; None if no view shows it."""
        size = next((each.size for each in self.panoramas if each.name == measured.image), None)
        if size is None:
            return measured
        xy = np.asarray([measured.x, measured.y])
        found = VIEW_SET.seen_at(panorama_directions(xy, size), self.side)
        if found is None:
            return None
        number, (x, y) = found
        name = view_name(measured.image, number)
        return measured._replace(image=name, x=float(x), y=float(y))

    def pairs(self, pairs: Iterable[Pair]) -> list[Pair]:
        """The pairs of views that pairs of photos mean. Views of one panorama are no pair."""
        views = {each.name: views_of(each.name) for each in self.panoramas}
        every = {
            make_pair(a, b)
            for one, other in pairs
            for a in views.get(one, [one])
            for b in views.get(other, [other])
        }
        own = self.panorama_of
        return sorted((a, b) for a, b in every if own.get(a, a) != own.get(b, b))


def planned_panoramas(
    images: Sequence[ImageFile], config: Config, options: RunOptions
) -> PanoramaPlan | None:
    """The plan for the panoramas among the photos of a run; None if there are no panoramas.

    Args:
      images: with their masks.

    Raises:
      UserError: an option does not go with panoramas, or the views would be too small.
    """
    if not 0 <= options.nadir < 90:
        raise UserError(f"--nadir must lie in 0 .. 90 degrees; got {options.nadir:g}")
    panoramas = panoramas_among(images, options.panorama)
    if not panoramas:
        return None
    names = {image.name for image in panoramas}
    if options.intrinsics is not None:
        raise UserError(
            f"--intrinsics: among the photos are panoramas ({named(sorted(names))}), whose views "
            "have a known camera; cameras of other photos cannot be given beside them"
        )
    widest = max(panoramas, key=lambda image: image.size[0])
    side = VIEW_SET.side(widest.size[0], config.max_size)
    if side < MIN_SIDE:
        raise UserError(
            f"{shown_name(widest.name)}: a panorama of {widest.size[0]} pixels width has views of "
            f"{side} pixels, which is too small (at least {MIN_SIDE})"
        )
    others = [image for image in images if image.name not in names]
    ours = tuple(views_of(""))
    if clash := [image.name for image in others if image.name.startswith(ours)]:
        raise UserError(
            f"{shown_name(clash[0])}: the folder of this photo has the name of one for the views "
            "of panoramas; rename it"
        )
    return PanoramaPlan(panoramas=panoramas, others=others, side=side, nadir_deg=options.nadir)


def panoramas_among(images: Iterable[ImageFile], choice: PanoramaChoice) -> list[ImageFile]:
    """The photos that are panoramas.

    Args:
      choice: auto: those that say so themselves. yes: all. no: none.

    Raises:
      UserError: all photos are said to be panoramas, but one has not the shape of one.
    """
    if choice == "auto":
        return [image for image in images if is_panorama(image)]
    if choice == "no":
        return []
    for image in (found := list(images)):
        if not is_equirectangular_size(image.size):
            raise UserError(
                f"--panorama yes: a panorama is twice as wide as high, but {shown_name(image.name)}"
                f" has {image.size[0]} x {image.size[1]} pixels"
            )
    return found


def refuse_panorama(image: ImageFile, command: str) -> None:
    """Raise ImageError if a photo says that it is a panorama, for a command that takes none."""
    if is_panorama(image):
        raise ImageError(
            f"{shown_name(image.name)}: {command} takes no 360-degree photos; give them to "
            "reconstruct with the others"
        )


def panorama_rig(side: int, numbers: Iterable[int]) -> Rig:
    """The rig of some of the views of panoramas, by their numbers: one centre, one focal length."""
    focal, centre = float(VIEW_SET.focal(side)), side / 2
    rotations, used = VIEW_SET.rotations(), sorted(numbers)
    cameras = [
        RigCamera(
            prefix=view_name("", number),
            rotation=np.eye(3) if number == used[0] else rotations[number] @ rotations[used[0]].T,
            translation=np.zeros(3),
            model="SIMPLE_PINHOLE",
            params=(focal, centre, centre),
        )
        for number in used
    ]
    return Rig(cameras=tuple(cameras), reference=0)


def view_name(panorama: str, number: int) -> str:
    """The name of a view of a panorama; of none, the beginning of such names."""
    jpeg = not panorama or PurePosixPath(panorama).suffix.lower() in (".jpg", ".jpeg")
    return f"pano_camera{number}/{panorama}{'' if jpeg else '.jpg'}"


def views_of(panorama: str) -> list[str]:
    """The names of all views of a panorama (`view_name`), in the order of `VIEW_SET`."""
    return [view_name(panorama, number) for number in range(len(VIEW_SET.directions))]
