"""A folder with the chosen frames of a video: `jaxsfm frames`."""

import dataclasses
import json
import logging
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
from tqdm import tqdm

from jaxsfm.errors import UserError, writing
from jaxsfm.io.atomic import Json, atomic_folder, sha256_of
from jaxsfm.io.entries import FRAMES_RECORD
from jaxsfm.io.images import shown_name
from jaxsfm.io.typed_files import read_json
from jaxsfm.io.video import Video, open_video
from jaxsfm.runs.video.choice import ChosenFrame, choose_frames
from jaxsfm.runs.video.motion import common_area

logger = logging.getLogger("jaxsfm")

OVERLAP = 0.8
"""The usual overlap of neighbouring frames."""
LEAST_OVERLAP, MOST_OVERLAP = 0.2, 0.98
JPEG_QUALITY = 95


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """Which frames are chosen; UserError for numbers that make no sense."""

    overlap: float = OVERLAP
    """The part of a view that the next chosen frame should show too."""
    most: int | None = None
    """The largest number of frames; None: as many as the camera's way asks for."""

    def __post_init__(self) -> None:
        if not LEAST_OVERLAP <= self.overlap <= MOST_OVERLAP:
            raise UserError(
                f"--overlap must lie in {LEAST_OVERLAP} .. {MOST_OVERLAP}; got {self.overlap:g}"
            )
        if self.most is not None and self.most < 2:
            raise UserError(f"--most must be at least 2; got {self.most}")


class FramesFolder(NamedTuple):
    """A folder with chosen frames."""

    names: list[str]
    """The names of the frames, in the order of the video."""
    common: float
    """The median part that neighbouring frames have in common; 0 if no neighbours do."""
    there: bool
    """Whether the frames had been chosen before."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Record:
    """What frames were made from, and which there are: the content of `frames.json`."""

    video: str
    sha256: str
    overlap: float
    most: int | None
    frames: dict[str, Annotated[float, msgspec.Meta(ge=0, le=1)] | None]
    """The part that each frame has in common with the frame before it, by name."""


class _Written(NamedTuple):
    """A frame that has been written, without its pixels."""

    name: str
    motion: np.ndarray | None
    size: tuple[int, int]


def frames_folder(
    video: Path, folder: Path, options: FrameOptions | None = None, *, progress: bool = False
) -> FramesFolder:
    """Choose frames of a video and write them into a new folder, or find them there.

    The frames are `frame-000123.jpg` with the number of the frame in the video, from 0. The file
    `frames.json` says what they were made from. The folder appears when it is complete.

    Args:
      options: None: the usual ones, and frames that are there may have been chosen with any.

    Raises:
      UserError: the video cannot be used, or shows one view all the time; the folder holds
        anything else, or cannot be written.
    """
    with open_video(video) as opened:
        source: dict[str, Json] = {"video": str(video.absolute()), "sha256": sha256_of(video)}
        found = _finished(folder, source, options)
        if found is not None:
            return found
        options = options or FrameOptions()
        with writing(f"--out {folder}"), atomic_folder(folder) as fresh:
            written = _write_frames(opened, fresh, options, progress=progress)
            if len(written) < 2:
                raise UserError(
                    f"{shown_name(str(video))}: the camera hardly moves, or nothing in the frames "
                    f"can be followed, so there are no two views with {options.overlap:g} or less "
                    "in common to choose"
                )
            frames = _with_common(written)
            record = source | dataclasses.asdict(options) | {"frames": frames}
            (fresh / FRAMES_RECORD).write_text(json.dumps(record, indent=1), encoding="utf-8")
    return _as_found(frames, there=False)


def _finished(
    folder: Path, source: dict[str, Json], options: FrameOptions | None
) -> FramesFolder | None:
    """The frames that an earlier call has written; None if the folder is new or empty."""
    shown = f"--out {folder}"
    if not folder.exists():
        return None
    if not folder.is_dir():
        raise UserError(f"{shown}: this is a file and not a folder")
    with writing(shown):
        inside = sorted(path.name for path in folder.iterdir())
    if not inside:
        return None
    record = read_json(folder / FRAMES_RECORD, _Record)
    if record is None:
        raise UserError(
            f"{shown}: the folder is not empty (it holds {inside[0]!r}); choose an empty or new "
            "folder"
        )
    asked = {"sha256": source["sha256"]} | (dataclasses.asdict(options) if options else {})
    if changed := [name for name, value in asked.items() if getattr(record, name) != value]:
        what = "of another video" if changed[0] == "sha256" else f"with another --{changed[0]}"
        raise UserError(
            f"{shown}: the folder holds frames that were chosen {what}; choose another folder or "
            "delete this one"
        )
    # Frames that the user has deleted since then stay away.
    left = {name: record.frames[name] for name in inside if name in record.frames}
    return _as_found(left, there=True)


def _as_found(frames: dict[str, float | None], *, there: bool) -> FramesFolder:
    common = [part for part in frames.values() if part is not None]
    return FramesFolder(list(frames), float(np.median(common)) if common else 0.0, there)


def _write_frames(
    video: Video, folder: Path, options: FrameOptions, *, progress: bool
) -> list[_Written]:
    written: list[_Written] = []
    frames = tqdm(
        video.frames(), total=video.announced, desc="frames", unit="frame", disable=not progress
    )
    for frame in choose_frames(frames, options.overlap):
        name = f"frame-{frame.index:06d}.jpg"
        (folder / name).write_bytes(_jpeg(frame))
        written.append(_Written(name, frame.motion, frame.size))
    if options.most is None or len(written) <= options.most:
        return written
    # The chosen frames lie at equal steps, so the remaining ones do too.
    kept = np.linspace(0, len(written) - 1, options.most).round().astype(int)
    for number in set(range(len(written))) - set(kept.tolist()):
        (folder / written[number].name).unlink()
    logger.info("%d of %d frames are kept, as --most asks", len(kept), len(written))
    return [
        written[end]._replace(motion=_joined([w.motion for w in written[start + 1 : end + 1]]))
        for start, end in zip([-1, *kept], kept, strict=False)
    ]


def _joined(motions: list[np.ndarray | None]) -> np.ndarray | None:
    """Motions one after the other; None if one of them is not known."""
    whole = np.eye(3)
    for motion in motions:
        if motion is None:
            return None
        whole = motion @ whole
    return whole


def _with_common(written: list[_Written]) -> dict[str, float | None]:
    """The part that each frame has in common with the frame before it, by name."""
    return {
        name: None if motion is None else round(common_area(motion, size), 4)
        for name, motion, size in written
    }


def _jpeg(frame: ChosenFrame) -> bytes:
    encoded, data = cv2.imencode(".jpg", frame.pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not encoded:
        raise UserError(f"frame {frame.index} cannot be written as JPEG")
    return data.tobytes()
