"""Which frames of a video are chosen: the sharpest of each stretch of the camera's way.

The way is measured in *steps*. The camera has made one step when its view has so little in common
with that of the last chosen frame as the user asked for. The next frame is the sharpest of those
between two thirds and four thirds of a step. So a camera that stands still gives no new frame, and
one that moves twice as fast gives twice as many frames a second.

Only a few frames are in memory, however long the video is.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from jaxsfm.runs.video.motion import (
    SmallFrame,
    common_area,
    detail_ratio,
    followed_motion,
    matched_motion,
)

FROM, TO = 2 / 3, 4 / 3
"""The next frame is chosen among those that are so many steps after the last chosen one. No frame
is passed over before its turn, because two times `FROM` is not less than `TO`."""
FIRST = 1 / 3
"""The first frame is chosen among those that are at most so many steps after the beginning."""
STILL = 0.9
"""While a frame has so much in common with the frame from which points are followed, this frame
stays the same, so that the errors of many small motions do not add up."""
PATIENCE = 15
"""After so many blurred frames whose motion is unknown, half a second, a new stretch begins."""
BLURRED = 0.5
"""A frame with a smaller share of another frame's detail is blurred, compared with it."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """A frame and its place on the camera's way."""

    index: int
    """Its number in the video, from 0."""
    pixels: np.ndarray
    """uint8 (h, w, 3), BGR."""
    small: SmallFrame
    way: np.ndarray
    """float64 (3, 3): the motion from the last chosen frame, or from the start of the stretch."""


@dataclasses.dataclass(frozen=True)
class ChosenFrame:
    """A frame that was chosen."""

    index: int
    """Its number in the video, from 0."""
    pixels: np.ndarray
    """uint8 (h, w, 3), BGR."""
    motion: np.ndarray | None
    """float64 (3, 3): from the frame that was chosen before it; None if it is not known, which is
    so for the first frame and after a cut."""
    size: tuple[int, int]
    """(width, height) of the small frames in whose pixels the motion is."""


class _Way:
    """The camera's way since the last chosen frame."""

    def __init__(self, overlap: float) -> None:
        self.overlap = overlap
        self.start: Frame | None = None
        """The last chosen frame; None at the beginning of a stretch."""
        self.base: Frame | None = None
        """The frame from which points are followed."""
        self.last: Frame | None = None
        """The last frame whose place is known."""
        self.best: Frame | None = None
        """The sharpest frame that may be chosen next."""
        self.lost = 0
        """The number of frames in a row whose place is unknown."""
        self.followed = False
        """Whether any motion could be measured since the beginning of the stretch. Black frames and
        bare walls have none, and are not chosen."""

    def add(self, index: int, pixels: np.ndarray) -> Iterator[ChosenFrame]:
        """Take the next frame of the video; yields the frames that are chosen because of it."""
        small = SmallFrame.of(pixels)
        if self.base is None or self.last is None or small.size != self.last.small.size:
            yield from self.restart(Frame(index, pixels, small, np.eye(3)))
            return
        way = self._way_to(small)
        if way is None:
            self.lost += 1
            blurred = small.detail.mean() < BLURRED * self.last.small.detail.mean()
            if not blurred or self.lost > PATIENCE:
                yield from self.restart(Frame(index, pixels, small, np.eye(3)))
            return
        frame = Frame(index, pixels, small, way)
        self.lost, self.last, self.followed = 0, frame, True
        if common_area(_between(self.base, frame), small.size) < STILL:
            self.base = frame
        yield from self._walked_to(frame)

    def restart(self, frame: Frame | None) -> Iterator[ChosenFrame]:
        """End the stretch, and begin a new one with a frame that has no known place, if given.

        The last step of a stretch is seldom whole, and a blurred frame is not worth it.
        """
        if self.best is not None and self.followed and not self._is_blurred(self.best):
            yield self._chosen(self.best)
        self.base = self.last = self.best = frame
        self.start, self.followed, self.lost = None, False, 0

    def _is_blurred(self, frame: Frame) -> bool:
        """Whether a frame is much less sharp than the last chosen one."""
        start = self.start
        return start is not None and detail_ratio(start.small, frame.small, frame.way) < BLURRED

    def _way_to(self, small: SmallFrame) -> np.ndarray | None:
        """The motion from the start of the way to a frame; None if it cannot be measured."""
        base, last = self.base, self.last
        assert base is not None and last is not None
        for start, measure in (
            (base, followed_motion),
            (last, followed_motion),
            (last, matched_motion),
        ):
            motion = measure(start.small, small)
            if motion is not None:
                return motion @ start.way
        return None

    def _walked_to(self, frame: Frame) -> Iterator[ChosenFrame]:
        while True:
            nearest, farthest = (FROM, TO) if self.start else (0.0, FIRST)
            steps = (1 - common_area(frame.way, frame.small.size)) / (1 - self.overlap)
            if steps <= farthest:
                if steps >= nearest and self._is_sharpest(frame):
                    self.best = frame
                return
            chosen = self.best or frame
            yield self._chosen(chosen)
            self._start_at(chosen)
            if chosen is frame:
                return
            assert self.last is not None
            frame = self.last

    def _is_sharpest(self, frame: Frame) -> bool:
        best = self.best
        return best is None or detail_ratio(best.small, frame.small, _between(best, frame)) > 1

    def _chosen(self, frame: Frame) -> ChosenFrame:
        motion = frame.way if self.start else None
        return ChosenFrame(frame.index, frame.pixels, motion, frame.small.size)

    def _start_at(self, chosen: Frame) -> None:
        """Let the way start at a frame that has been chosen."""
        back = np.linalg.inv(chosen.way)
        assert self.base is not None and self.last is not None
        self.base = dataclasses.replace(self.base, way=self.base.way @ back)
        self.last = dataclasses.replace(self.last, way=self.last.way @ back)
        self.best, self.start = None, dataclasses.replace(chosen, way=np.eye(3))


def _between(first: Frame, second: Frame) -> np.ndarray:
    return second.way @ np.linalg.inv(first.way)


def choose_frames(frames: Iterable[np.ndarray], overlap: float) -> Iterator[ChosenFrame]:
    """The sharpest frame of each stretch of a camera's way, in the order of the video.

    Args:
      frames: the frames of a video, uint8 (h, w, 3), BGR.
      overlap: the part of a view that the next chosen frame should show too, between 0 and 1.
    """
    if not 0 < overlap < 1:
        raise ValueError(f"overlap must lie between 0 and 1; got {overlap}")
    way = _Way(overlap)
    for index, pixels in enumerate(frames):
        yield from way.add(index, pixels)
    yield from way.restart(None)
