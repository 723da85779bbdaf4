"""The frames of a video with reference poses that a benchmark uses, and their camera."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from jaxsfm.bench.options import CameraUse
from jaxsfm.colmap.poses import Poses
from jaxsfm.errors import UserError
from jaxsfm.io.pair_selection import natural
from jaxsfm.options import Mapper

PHOTOS = (".jpg", ".jpeg", ".png")


class Frames(NamedTuple):
    """The frames of a folder that are used."""

    mapped: list[Path]
    localized: list[Path]


def chosen_frames(folder: Path, every: int, localize: int) -> Frames:
    """Each `every`-th frame by name; of these, each `localize`-th is localized (0: none).

    Raises:
      UserError: there are fewer than three frames.
    """
    found = [p for p in folder.iterdir() if p.suffix.lower() in PHOTOS]
    frames = sorted(found, key=lambda path: natural(path.name))[::every]
    if len(frames) < 3:
        raise UserError(f"{folder}: fewer than three frames")
    out = frames[localize // 2 :: localize] if localize else []
    return Frames([path for path in frames if path not in out], out)


def linked(photos: Path, names: Iterable[str], folder: Path) -> Path:
    """A folder with links to some photos of another one, by their paths below it, and no others."""
    wanted = {folder / name: (photos / name).absolute() for name in names}
    for path in list(folder.rglob("*")):
        if path.is_symlink() and wanted.get(path) != path.readlink():
            path.unlink()
    for link, photo in wanted.items():
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.is_symlink():
            link.symlink_to(photo)
    return folder


class FrameSequence(NamedTuple):
    """The input of all methods."""

    folder: Path
    """Of the frames and their poses."""
    frames: Frames
    work: Path
    """Where results are kept."""
    camera: CameraUse
    """What is done with the camera of the folder."""
    mapper: Mapper
    """Of the presets."""
    truth: Poses

    @property
    def intrinsics(self) -> str | None:
        """The value of `--intrinsics`; None: the camera is not known."""
        return None if self.camera == "unknown" else str(self.folder / "K.txt")

    @property
    def held(self) -> str | None:
        """The value of `--intrinsics` for photos whose camera is not adjusted."""
        return self.intrinsics if self.camera == "known" else None
