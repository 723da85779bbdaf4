"""The sets of `bench ledger`: their photos, what is known of them, and how models are judged.

Ordinary sets should give a whole model without a doubt. Ambiguous ones repeat themselves; their
models should be right, or doubted. Hard ones may give less. Half of the rendered scenes are for
choosing by, and results are reported of the other half.

The photos come in several layouts. A function `as_...` is given the folder of a set's data and a
folder of the set's own in which it may write. It raises UserError if a photo, a camera or a pose
cannot be read.
"""

import fnmatch
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image

from jaxsfm.bench import ordinary, repeated
from jaxsfm.bench.inputs import check_root, choose_sets, chosen_frames, linked, read_set
from jaxsfm.bench.judges import Judge
from jaxsfm.bench.synthetic import camera_text, write_photo
from jaxsfm.colmap.poses import CameraPose, Poses, read_poses
from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import atomic_folder
from jaxsfm.io.extras import extra
from jaxsfm.io.photo_folder import find_images
from jaxsfm.sfm.evaluation import of_photos

Kind = Literal["ordinary", "ambiguous", "hard"]
Half = Literal["", "choose", "report"]
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
QUARTER = np.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
"""Camera of an upright photo -> camera of the photo that is stored turned clockwise."""


class SetPhotos(NamedTuple):
    """The photos of a set as a run gets them."""

    photos: Path
    truth: Poses | None = None
    """The reference poses of these photos; None without any."""
    intrinsics: str | None = None
    """The value of `--intrinsics`; None: the cameras are not known."""
    pairs: str = "auto"


def as_strecha(folder: Path, home: Path) -> SetPhotos:
    """A set in Strecha's layout; its camera is known."""
    del home
    found = read_set(folder)
    return SetPhotos(folder / "images", found.truth, found.camera, "exhaustive")


def as_frames(folder: Path, home: Path, *, every: int = 1, first: int | None = None) -> SetPhotos:
    """Photos with NAME.pose.txt and K.txt beside them; all, or links to each so-many-th one, or to
    so many first ones."""
    truth, camera, photos = read_poses(folder, option="--root"), str(folder / "K.txt"), folder
    if first is not None or every > 1:
        names = [path.name for path in chosen_frames(folder, every, 0).mapped[:first]]
        with writing(f"--out {home}"):
            photos = linked(folder, names, home / "photos")
        truth = of_photos(truth, names)
    return SetPhotos(photos, truth, camera)


def as_photos(folder: Path, home: Path) -> SetPhotos:
    """Photos of which nothing is known."""
    del home
    return SetPhotos(folder)


def as_photos_with_poses(folder: Path, home: Path) -> SetPhotos:
    """Photos with reference poses beside them."""
    del home
    return SetPhotos(folder, read_poses(folder, option="--root"))


def as_phototourism(folder: Path, home: Path) -> SetPhotos:
    """mapping/NAME.jpg, and ground_truth/calibration_NAME.h5 with x = K (R X + T)."""
    del home
    with extra("hdf5", f"{folder}: the files of its cameras need"):
        import h5py
    truth = {}
    for path in sorted((folder / "ground_truth").glob("calibration_*.h5")):
        try:
            with h5py.File(path, "r") as file:
                rotation = np.asarray(file["R"], np.float64)
                shift = np.asarray(file["T"], np.float64)
        except (OSError, KeyError) as error:
            raise UserError(f"--root: {path} is not a file with R and T of a camera") from error
        name = path.stem.removeprefix("calibration_")
        truth[name] = CameraPose(rotation, -rotation.T @ shift.reshape(3))
    return SetPhotos(folder / "mapping", truth or None)


def as_turned(folder: Path, home: Path) -> SetPhotos:
    """The photos of a set in Strecha's layout, every second of them stored turned clockwise.

    Nothing says so, and the cameras are not known. The poses are those of the stored photos.
    """
    scene = home / "scene"
    if not scene.is_dir():
        with writing(f"--out {scene}"):
            _write_turned(folder, scene)
    return SetPhotos(scene / "images", read_poses(scene, option="--out"))


def _write_turned(folder: Path, scene: Path) -> None:
    truth = read_set(folder).truth
    with atomic_folder(scene) as fresh:
        (fresh / "images").mkdir()
        (fresh / "gt_dense_cameras").mkdir()
        for k, name in enumerate(find_images(folder / "images")):
            ((_, pose),) = of_photos(truth, [name]).items()
            if k % 2:
                upright = np.asarray(Image.open(folder / "images" / name).convert("RGB"))
                name = f"{Path(name).stem}.png"
                stored = np.ascontiguousarray(np.rot90(upright, -1))
                write_photo(fresh / "images" / name, stored)
                pose = CameraPose(QUARTER @ pose.rotation, pose.centre)
            else:
                shutil.copyfile(folder / "images" / name, fresh / "images" / name)
            # Only the pose is read from this file.
            text = camera_text(np.eye(3), pose, (1, 1))
            path = fresh / "gt_dense_cameras" / f"{name}.camera"
            path.write_text(text, encoding="ascii")


def as_drawn(source: Path, home: Path, *, write: Callable[[Path], None]) -> SetPhotos:
    """A rendered scene, in the folder `home`/scene, which `write` writes if it is not there."""
    del source
    folder = home / "scene"
    with writing(f"--out {folder}"):
        write(folder)
    return as_strecha(folder, home)


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
        scene = names[number // 2 % len(names)]
        half: Half = "report" if number % 2 else "choose"
        how = partial(as_drawn, write=partial(write, name=scene, seed=number, size=size))
        found.append(LedgerSet(f"{scene}-{number:02d}", kind, root, how, half=half))
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
