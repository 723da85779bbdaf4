"""Reading the frames of a video file."""

import contextlib
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.images import shown_name
from jaxsfm.io.photo_folder import SUFFIXES

logger = logging.getLogger(__name__)

# FFmpeg prints a line for each damaged packet; jaxsfm says in one sentence what cannot be decoded.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
FEWER = 0.95
"""If a smaller share of the frames that the file announces can be decoded, a warning says so. Many
files announce a few frames too many."""
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
"""Bytes that no text has, and the first 4 kB of any video have."""


class Video:
    """An open video file; `open_video` makes one."""

    def __init__(self, path: Path, capture: cv2.VideoCapture) -> None:
        self.path = path
        self._capture = capture

    @property
    def announced(self) -> int:
        """The number of frames as the file announces it, which may be wrong; 0 if it does not."""
        return max(0, int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))

    def frames(self) -> Iterator[np.ndarray]:
        """The frames as uint8 (h, w, 3), in OpenCV's order BGR, turned as the file asks.

        They can be read once. The log says if much fewer frames can be decoded than the file
        announces.

        Raises:
          UserError: no frame can be decoded.
        """
        count = 0
        while True:
            interrupt.check()
            decoded, frame = self._capture.read()
            if not decoded:
                break
            count += 1
            yield frame
        shown = shown_name(str(self.path))
        if count == 0:
            raise UserError(
                f"{shown}: no frame of this video can be decoded; convert it to H.264 first"
            )
        if count < FEWER * self.announced:
            logger.warning(
                "%s: only the first %d of %d frames can be decoded", shown, count, self.announced
            )


@contextlib.contextmanager
def open_video(path: Path) -> Iterator[Video]:
    """Open a video file while the block runs.

    Raises:
      UserError: there is no such file, or it is not a video.
    """
    shown = shown_name(str(path))
    try:
        if not path.exists():
            raise UserError(f"{shown}: no such file")
        if not path.is_file():
            raise UserError(f"{shown}: not a file; frames are chosen from a video file")
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise UserError(f"{shown}: cannot be read ({error.strerror})") from error
    if not head:
        raise UserError(f"{shown}: the file is empty")
    # OpenCV would open a photo as a video of one frame, or with all photos numbered after it.
    if path.suffix.lower() in SUFFIXES:
        raise UserError(f"{shown}: this is a photo and not a video")
    # FFmpeg would show a text as a film of a terminal, and open the files that a playlist names.
    if not _CONTROL.search(head):
        raise UserError(f"{shown}: this is a text and not a video")
    # The absolute path keeps FFmpeg from reading a name with a colon as the name of a protocol.
    capture = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise UserError(f"{shown}: not a video that can be read")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        yield Video(path, capture)
    finally:
        capture.release()
