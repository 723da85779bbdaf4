"""Panoramas in a run: before it, each is turned into pinhole views, which are a rig of one centre.

The views lie in the work folder, `views/pano_camera0/NAME.jpg` and so on, beside the ordinary
photos of a mixed folder. This is the run's folder of photos.
"""

import dataclasses
import json
import logging
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from tqdm import tqdm

from jaxsfm.colmap.panorama_poses import panorama_poses, write_panorama_table
from jaxsfm.colmap.poses import model_poses
from jaxsfm.config import Config
from jaxsfm.core.panorama import Direction, ViewSet
from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.entries import PANORAMAS, RECORD, VIEW_MASKS, VIEWS, VIEWS_RECORD, entry
from jaxsfm.io.images import ImageError, ImageFile, image_bytes, named, shown_name
from jaxsfm.io.masks import mask_path
from jaxsfm.io.panoramas import (
    is_equirectangular_size,
    is_panorama,
    jpeg_with_gps,
    read_panorama,
    render_masks,
    render_views,
    without_nadir,
)
from jaxsfm.io.photo_folder import with_masks
from jaxsfm.io.rig_config import Rig, RigCamera
from jaxsfm.io.typed_files import read_json
from jaxsfm.io.work_folder import lock_folder
from jaxsfm.options import PanoramaChoice
from jaxsfm.runs.run_options import RunOptions

if TYPE_CHECKING:
    import pycolmap

logger = logging.getLogger("jaxsfm")

VIEW_SET = ViewSet(tuple(Direction(60.0 * k, 0.0) for k in range(6)), 90.0)
"""Which views a panorama has (docs/decisions/panoramas.md). The first one looks to the middle of
the panorama, so its axes are those of the panorama, and of the rig."""
FORMAT = 1
"""Of the views; another number where they are rendered differently."""
JPEG_QUALITY = 95


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
    def panorama_of(self) -> dict[str, str]:
        """The panorama of each view, by the view's name."""
        return {view: name for view, (name, _) in self.view_of.items()}

    @property
    def panoramas(self) -> list[str]:
        """Their names."""
        return sorted({name for name, _ in self.view_of.values()})

    def write_poses(self, folder: Path, models: Sequence["pycolmap.Reconstruction"]) -> None:
        """Write the poses that the panoramas have in models into a table in a folder."""
        found = [panorama_poses(model_poses(each), VIEW_SET, self.view_of) for each in models]
        write_panorama_table(folder / PANORAMAS, found)
        placed = len({name for poses in found for name in poses})
        logger.info("%d of %d panoramas have a pose (%s)", placed, len(self.panoramas), PANORAMAS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Record:
    """What a folder of views was made from, and the views in it: the content of `views.json`."""

    made_from: dict[str, object]
    view_of: dict[str, tuple[str, int]]
    lost: dict[str, str] = dataclasses.field(default_factory=dict)
    """The panoramas that could not be read, and why. They are tried again."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """How panoramas are turned into views."""

    most_px: int
    """The largest side of a view, pixels."""
    nadir_deg: float
    """So many degrees around straight down are not used; 0: all is."""

    def __post_init__(self) -> None:
        if not 0 <= self.nadir_deg < 90:
            raise UserError(f"--nadir must lie in 0 .. 90 degrees; got {self.nadir_deg:g}")


def prepared_panoramas(
    images: Sequence[ImageFile], out: Path, config: Config, options: RunOptions
) -> PanoramaViews | None:
    """The views of the panoramas among the photos of a run; None if there are no panoramas.

    Raises:
      UserError: an option does not go with panoramas, or the views cannot be written (see
        `panorama_views`).
    """
    chosen = ViewOptions(most_px=config.max_size, nadir_deg=options.nadir)
    names = [image.name for image in panoramas_among(images, options.panorama)]
    if not names:
        return None
    if options.intrinsics is not None:
        raise UserError(
            f"--intrinsics: among the photos are panoramas ({named(names)}), whose views have a "
            "known camera; cameras of other photos cannot be given beside them"
        )
    if options.masks is not None:
        images = with_masks(images, options.masks)[0]
    panoramas = [image for image in images if image.name in set(names)]
    with lock_folder(out):
        return panorama_views(images, panoramas, out, chosen, progress=options.progress)


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


def panorama_views(
    images: Sequence[ImageFile],
    panoramas: Collection[ImageFile],
    out: Path,
    options: ViewOptions,
    *,
    progress: bool = False,
) -> PanoramaViews:
    """Write the views of panoramas and copies of the other photos into the work folder, or find
    those that an earlier call has written of the same photos.

    All views have one size, so that they are one rig: that for the largest panorama.

    Args:
      images: all photos of the run, with their masks.
      panoramas: those of `images` that are panoramas.
      out: the work folder.

    Raises:
      UserError: a photo cannot be read or a file cannot be written; or the folder holds a run of
        other photos, or of these photos in another size.
    """
    side = VIEW_SET.side(max(image.size[0] for image in panoramas), options.most_px)
    names = {image.name for image in panoramas}
    others = [image for image in images if image.name not in names]
    ours = tuple(view_name("", number) for number in range(len(VIEW_SET.directions)))
    if clash := [image.name for image in others if image.name.startswith(ours)]:
        raise UserError(
            f"{shown_name(clash[0])}: the folder of this photo has the name of one for the views "
            "of panoramas; rename it"
        )
    made_from = {
        "format": FORMAT,
        "views": dataclasses.asdict(VIEW_SET),
        "side": side,
        "nadir": options.nadir_deg,
        "panoramas": {image.name: image.content for image in panoramas},
        "photos": {image.name: image.content for image in others},
    }
    folder, masks = entry(out, VIEWS), entry(out, VIEW_MASKS)
    view_of, lost = _written_before(folder, made_from), dict[str, str]()
    if view_of is None:
        _check_folder(out, made_from)
        # The masks are in their place first: views without them would be taken for whole ones.
        with writing(folder), atomic_folder(folder) as fresh, atomic_folder(masks) as fresh_masks:
            view_of = {}
            bar = tqdm(panoramas, desc="views", unit="panorama", disable=not progress)
            for image in bar:
                writer = _Writer(image, fresh, fresh_masks)
                try:
                    view_of |= writer.views(side, options.nadir_deg)
                except ImageError as error:
                    lost[image.name] = str(error)
                    logger.warning("%s", error)
            for image in others:
                _put(fresh / image.name, image_bytes(image))
                if image.mask is not None:
                    _put(mask_path(fresh_masks, image.name), image.mask.path.read_bytes())
            record = {"made_from": made_from, "view_of": view_of, "lost": lost}
            (fresh / VIEWS_RECORD).write_text(json.dumps(record, indent=1), encoding="utf-8")
    logger.info(
        "%d panoramas are %d views of %d x %d pixels, in %s",
        len({name for name, _ in view_of.values()}),
        len(view_of),
        side,
        side,
        folder,
    )
    if not view_of:
        raise UserError(f"{named(sorted(names))}: nothing of these panoramas can be used")
    masked = masks if any(masks.rglob("*.png")) else None
    rig = panorama_rig(side, {number for _, number in view_of.values()})
    return PanoramaViews(folder=folder, masks=masked, view_of=view_of, rig=rig, lost=lost)


def _check_folder(out: Path, made_from: dict[str, Any]) -> None:
    """Raise UserError if views would take the place of those of another run: the run could not go
    on with them, and what it has made would be of other photos."""
    record = read_json(entry(out, VIEWS) / VIEWS_RECORD, _Record)
    before: dict[str, Any] = record.made_from if record is not None else {}
    shared = before.get("panoramas", {}).keys() & made_from["panoramas"].keys()
    same = shared and before.get("side") == made_from["side"]
    if not same and entry(out, RECORD).exists():
        raise UserError(
            f"--out {out}: the folder holds a run of other photos, or one that has other views of "
            "these panoramas or none; choose another folder or delete this one"
        )


def _written_before(folder: Path, made_from: dict[str, Any]) -> dict[str, tuple[str, int]] | None:
    """The views that are there; None if they were made from anything else, or one is gone."""
    record = read_json(folder / VIEWS_RECORD, _Record)
    made_from = json.loads(json.dumps(made_from))  # tuples are lists in JSON
    if record is None or record.made_from != made_from or record.lost:
        return None
    photos = (*record.view_of, *made_from["photos"])
    return record.view_of if all((folder / name).is_file() for name in photos) else None


@dataclasses.dataclass(frozen=True)
class _Writer:
    """Writes the views of a panorama into new folders of photos and of masks."""

    image: ImageFile
    folder: Path
    masks: Path

    def views(self, side: int, nadir_deg: float) -> dict[str, tuple[str, int]]:
        """The views that were written: those of which something may be used. ImageError if the
        panorama cannot be read."""
        rgb, used = read_panorama(self.image)
        height, width = rgb.shape[:2]
        if nadir_deg > 0:
            upper = without_nadir((width, height), nadir_deg)
            used = upper if used is None else used & upper
        shown = None if used is None else [*render_masks(used, VIEW_SET, side)]
        written = {}
        for number, view in enumerate(render_views(rgb, VIEW_SET, side)):
            name = view_name(self.image.name, number)
            if shown is not None:
                if not shown[number].any():
                    continue
                png = cv2.imencode(".png", 255 * shown[number].astype(np.uint8))[1]
                _put(mask_path(self.masks, name), png.tobytes())
            _put(self.folder / name, jpeg_with_gps(view, self.image, JPEG_QUALITY))
            written[name] = (self.image.name, number)
        return written


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
