"""The folder of the views that a run makes of its panoramas.

The views lie in the work folder, `views/pano_camera0/NAME.jpg` and so on, beside the ordinary
photos of a mixed folder. This is the run's folder of photos.
"""

import dataclasses
import json
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import atomic_folder, sha256_of
from jaxsfm.io.entries import RECORD, VIEW_MASKS, VIEWS, VIEWS_RECORD, entry
from jaxsfm.io.images import ImageError, ImageFile, image_bytes, named
from jaxsfm.io.masks import mask_path
from jaxsfm.io.panoramas import (
    gps_as_exif,
    read_panorama,
    render_masks,
    render_views,
    view_as_jpeg,
    without_nadir,
)
from jaxsfm.io.typed_files import read_json
from jaxsfm.io.work_folder import lock_folder
from jaxsfm.runs.panoramas import (
    VIEW_SET,
    PanoramaPlan,
    PanoramaViews,
    panorama_rig,
    view_name,
    views_of,
)

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
    sha256: dict[str, str] = dataclasses.field(default_factory=dict)
    """Of each file of a view, of another photo or of a mask, by its path in the work folder."""

    def views(self, panorama: ImageFile) -> dict[str, tuple[str, int]]:
        """The views of a panorama."""
        every = {name: (panorama.name, k) for k, name in enumerate(views_of(panorama.name))}
        return {name: at for name, at in every.items() if name in self.view_of}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Run:
    """The photos in the record of a run."""

    images: dict[str, str]


class _Places(NamedTuple):
    """The folder of the views and that of their masks."""

    views: Path
    masks: Path

    def files(self, names: Iterable[str]) -> dict[str, Path]:
        """The files that photos and their masks have or would have, by their names in `_Record`."""
        found = dict[str, Path]()
        for name in names:
            found[f"{VIEWS}/{name}"] = self.views / name
            found[f"{VIEW_MASKS}/{name}"] = mask_path(self.masks, name)
        return found


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
    old = _Places(entry(out, VIEWS), entry(out, VIEW_MASKS))
    record = read_json(old.views / VIEWS_RECORD, _Record)
    kept = _kept(plan, record, json.loads(json.dumps(made_from)), old)  # tuples are lists in JSON
    if record is None or len(kept) < len(plan.panoramas) + len(plan.others):
        _check_folder(plan, record, out)
        # The masks are in their place first: views without them would be taken for whole ones.
        with (
            writing(old.views),
            atomic_folder(old.views) as views,
            atomic_folder(old.masks) as masks,
        ):
            record = _written(plan, kept, record, (old, _Places(views, masks)), progress=progress)
            record = dataclasses.replace(record, made_from=made_from)
            text = json.dumps(dataclasses.asdict(record), indent=1)
            (views / VIEWS_RECORD).write_text(text, encoding="utf-8")
    view_of = {name: at for each in plan.panoramas for name, at in record.views(each).items()}
    logger.info(
        "%d panoramas are %d views of %d x %d pixels, in %s",
        len({name for name, _ in view_of.values()}),
        len(view_of),
        plan.side,
        plan.side,
        old.views,
    )
    if not view_of:
        names = sorted(image.name for image in plan.panoramas)
        raise UserError(f"{named(names)}: nothing of these panoramas can be used")
    return PanoramaViews(
        folder=old.views,
        masks=old.masks if any(old.masks.rglob("*.png")) else None,
        view_of=view_of,
        rig=panorama_rig(plan.side, {number for _, number in view_of.values()}),
        lost=record.lost,
    )


def _kept(
    plan: PanoramaPlan, record: _Record | None, made_from: dict[str, Any], places: _Places
) -> set[str]:
    """The photos of which an earlier call made all that is made of them now, unless its files have
    been deleted or damaged since."""
    if record is None or any(
        record.made_from.get(key) != made_from[key] for key in ("format", "views", "side", "nadir")
    ):
        return set()
    kept = set[str]()
    for kind, images in (("panoramas", plan.panoramas), ("photos", plan.others)):
        before = record.made_from.get(kind)
        for image in images:
            names = views_of(image.name) if kind == "panoramas" else [image.name]
            if (
                isinstance(before, dict)
                and before.get(image.name) == image.content
                and image.name not in record.lost
                and all(
                    (sha256_of(path) if path.is_file() else None) == record.sha256.get(key)
                    for key, path in places.files(names).items()
                )
            ):
                kept.add(image.name)
    return kept


def _written(
    plan: PanoramaPlan,
    kept: set[str],
    before: _Record | None,
    places: tuple[_Places, _Places],
    *,
    progress: bool,
) -> _Record:
    """Write the files of all photos into new folders. Those of `kept` are copied."""
    old, new = places
    view_of, lost = dict[str, tuple[str, int]](), dict[str, str]()
    for image in tqdm(plan.panoramas, desc="views", unit="panorama", disable=not progress):
        if before is not None and image.name in kept:
            own = before.views(image)
            view_of |= own
            target = new.files(own)
            for key, path in old.files(own).items():
                if path.is_file():
                    _put(target[key], path.read_bytes())
            continue
        try:
            view_of |= _write_views(image, new, plan)
        except ImageError as error:
            lost[image.name] = str(error)
            logger.warning("%s", error)
    for image in plan.others:
        _put(new.views / image.name, image_bytes(image))
        if image.mask is not None:
            _put(mask_path(new.masks, image.name), image.mask.path.read_bytes())
    files = new.files([*view_of, *(image.name for image in plan.others)])
    sha256 = {key: sha256_of(path) for key, path in files.items() if path.is_file()}
    return _Record(made_from={}, view_of=view_of, lost=lost, sha256=sha256)


def _check_folder(plan: PanoramaPlan, record: _Record | None, out: Path) -> None:
    """Raise UserError if views would take the place of those of another run: the run could not go
    on with them, and what it has made would be of other photos."""
    if not entry(out, RECORD).exists():
        return
    if record is None:  # the views have been deleted; the run says whether it had such ones
        run = read_json(entry(out, RECORD), _Run)
        same = run is not None and bool(plan.panorama_of.keys() & run.images.keys())
    else:
        before = record.made_from.get("panoramas")
        shared = isinstance(before, dict) and any(each.name in before for each in plan.panoramas)
        same = shared and record.made_from.get("side") == plan.side
    if not same:
        raise UserError(
            f"--out {out}: the folder holds a run of other photos, or one that has other views of "
            "these panoramas or none; choose another folder or delete this one"
        )


def _write_views(
    image: ImageFile, places: _Places, plan: PanoramaPlan
) -> dict[str, tuple[str, int]]:
    """Write the views of a panorama of which something may be used, with their masks, and say which
    they are. ImageError if the panorama cannot be read."""
    rgb, used = read_panorama(image)
    height, width = rgb.shape[:2]
    if plan.nadir_deg > 0:
        upper = without_nadir((width, height), plan.nadir_deg)
        used = upper if used is None else used & upper
    shown = None if used is None else [*render_masks(used, VIEW_SET, plan.side)]
    written, exif = {}, gps_as_exif(image)
    for number, view in enumerate(render_views(rgb, VIEW_SET, plan.side)):
        name = view_name(image.name, number)
        if shown is not None:
            if not shown[number].any():
                continue
            png = cv2.imencode(".png", 255 * shown[number].astype(np.uint8))[1]
            _put(mask_path(places.masks, name), png.tobytes())
        _put(places.views / name, view_as_jpeg(view, exif, JPEG_QUALITY))
        written[name] = (image.name, number)
    return written


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
