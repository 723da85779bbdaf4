"""The folder of the views that a run makes of its panoramas.

The views lie in the work folder, `views/pano_camera0/NAME.jpg` and so on, beside the ordinary
photos of a mixed folder. This is the run's folder of photos.
"""

import dataclasses
import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.entries import RECORD, VIEW_MASKS, VIEWS, VIEWS_RECORD, entry
from jaxsfm.io.images import ImageError, ImageFile, image_bytes, named
from jaxsfm.io.masks import mask_path
from jaxsfm.io.panoramas import (
    jpeg_with_gps,
    read_panorama,
    render_masks,
    render_views,
    without_nadir,
)
from jaxsfm.io.typed_files import read_json
from jaxsfm.io.work_folder import lock_folder
from jaxsfm.runs.panoramas import VIEW_SET, PanoramaPlan, PanoramaViews, panorama_rig, view_name

logger = logging.getLogger("jaxsfm")

FORMAT = 1
"""Of the views; another number where they are rendered differently."""
JPEG_QUALITY = 95


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Record:
    """What a folder of views was made from, and the views in it: the content of `views.json`."""

    made_from: dict[str, object]
    view_of: dict[str, tuple[str, int]]
    lost: dict[str, str] = dataclasses.field(default_factory=dict)
    """The panoramas that could not be read, and why. They are tried again."""


def panorama_views(plan: PanoramaPlan, out: Path, *, progress: bool = False) -> PanoramaViews:
    """Write the views of panoramas and copies of the other photos into the work folder, or find
    those that an earlier call has written of the same photos.

    Args:
      out: the work folder, which is locked meanwhile.

    Raises:
      UserError: a photo cannot be read or a file cannot be written; or the folder holds a run of
        other photos, or of these photos in another size.
    """
    with lock_folder(out):
        return _views(plan, out, progress=progress)


def _views(plan: PanoramaPlan, out: Path, *, progress: bool) -> PanoramaViews:
    made_from = {
        "format": FORMAT,
        "views": dataclasses.asdict(VIEW_SET),
        "side": plan.side,
        "nadir": plan.nadir_deg,
        "panoramas": {image.name: image.content for image in plan.panoramas},
        "photos": {image.name: image.content for image in plan.others},
    }
    folder, masks = entry(out, VIEWS), entry(out, VIEW_MASKS)
    view_of, lost = _written_before(folder, made_from), dict[str, str]()
    if view_of is None:
        _check_folder(out, made_from)
        # The masks are in their place first: views without them would be taken for whole ones.
        with writing(folder), atomic_folder(folder) as fresh, atomic_folder(masks) as fresh_masks:
            view_of = {}
            bar = tqdm(plan.panoramas, desc="views", unit="panorama", disable=not progress)
            for image in bar:
                writer = _Writer(image, fresh, fresh_masks)
                try:
                    view_of |= writer.views(plan.side, plan.nadir_deg)
                except ImageError as error:
                    lost[image.name] = str(error)
                    logger.warning("%s", error)
            for image in plan.others:
                _put(fresh / image.name, image_bytes(image))
                if image.mask is not None:
                    _put(mask_path(fresh_masks, image.name), image.mask.path.read_bytes())
            record = {"made_from": made_from, "view_of": view_of, "lost": lost}
            (fresh / VIEWS_RECORD).write_text(json.dumps(record, indent=1), encoding="utf-8")
    logger.info(
        "%d panoramas are %d views of %d x %d pixels, in %s",
        len({name for name, _ in view_of.values()}),
        len(view_of),
        plan.side,
        plan.side,
        folder,
    )
    if not view_of:
        names = sorted(image.name for image in plan.panoramas)
        raise UserError(f"{named(names)}: nothing of these panoramas can be used")
    return PanoramaViews(
        folder=folder,
        masks=masks if any(masks.rglob("*.png")) else None,
        view_of=view_of,
        rig=panorama_rig(plan.side, {number for _, number in view_of.values()}),
        lost=lost,
    )


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
