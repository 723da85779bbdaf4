"""How far a camera has moved between two frames of a video, and which of two frames is sharper.

A motion is a float64 (3, 3) matrix that takes pixels of one small grey frame to those of another: a
turn, a scale and a shift. This simple form is enough to say how much two frames have in common, and
a chain of many of them stays near the truth. The small frames have at most `SIDE` pixels.
"""

import dataclasses

import cv2
import numpy as np

SIDE = 480
"""The longer side of the frame in which motion is measured, pixels."""
SHARP_SIDE = 1600
"""The longer side of the frame in which sharpness is measured, pixels. It is the largest size at
which photos are described, so blur that is lost in reducing does not matter."""
CORNERS = 400
LEAST = 20
"""So many points must be followed, else the motion is unknown."""
BACK_PX = 1.0
"""A point that is followed to the next frame and back must come back so near to its start."""
NEAR_PX = 3.0
"""Points that differ by less from the motion agree with it. Near and far points move differently,
so the limit is not tight."""
LEVELS = 4
WINDOW = (21, 21)
FEATURES = 1000


@dataclasses.dataclass(frozen=True)
class SmallFrame:
    """What is kept of a frame to compare it with others."""

    grey: np.ndarray
    """uint8 (h, w): the reduced frame."""
    detail: np.ndarray
    """float32 (h, w): the mean squared Laplacian around each pixel. Blur makes it smaller."""

    @classmethod
    def of(cls, frame: np.ndarray) -> "SmallFrame":
        """Reduce a frame, uint8 (h, w, 3), BGR."""
        grey = _at_most(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), SHARP_SIDE)
        # A little smoothing keeps the noise of single pixels from looking like sharpness.
        edges = cv2.Laplacian(cv2.GaussianBlur(grey, (3, 3), 0), cv2.CV_32F)
        return cls(_at_most(grey, SIDE), _at_most(edges * edges, SIDE))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.grey.shape[1], self.grey.shape[0]


def _at_most(image: np.ndarray, side: int) -> np.ndarray:
    height, width = image.shape[:2]
    factor = side / max(height, width)
    if factor >= 1:
        return image
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def followed_motion(first: SmallFrame, second: SmallFrame) -> np.ndarray | None:
    """The motion between two frames that differ little; None if it cannot be measured.

    Corners are followed with the pyramidal method of Lucas and Kanade (Bouguet 2000), to the second
    frame and back. RANSAC finds the motion with which most of them agree.
    """
    start = cv2.goodFeaturesToTrack(first.grey, CORNERS, 0.01, 8)
    if start is None or len(start) < LEAST:
        return None
    follow = {"winSize": WINDOW, "maxLevel": LEVELS}
    room = np.empty_like(start)
    end, there, _ = cv2.calcOpticalFlowPyrLK(first.grey, second.grey, start, room, **follow)
    room = np.empty_like(start)
    back, again, _ = cv2.calcOpticalFlowPyrLK(second.grey, first.grey, end, room, **follow)
    error = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    good = (there.ravel() == 1) & (again.ravel() == 1) & (error < BACK_PX)
    return _similarity(start[good].reshape(-1, 2), end[good].reshape(-1, 2))


def matched_motion(first: SmallFrame, second: SmallFrame) -> np.ndarray | None:
    """The motion between two frames that may differ much; None if it cannot be measured.

    It is measured with ORB features (Rublee et al. 2011), which may be anywhere in the frame.
    """
    orb = cv2.ORB.create(FEATURES)
    here, descriptors = orb.detectAndCompute(first.grey, None)
    there, others = orb.detectAndCompute(second.grey, None)
    if descriptors is None or others is None:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, others)
    start = np.asarray([here[m.queryIdx].pt for m in matches], np.float32).reshape(-1, 2)
    end = np.asarray([there[m.trainIdx].pt for m in matches], np.float32).reshape(-1, 2)
    return _similarity(start, end)


def _similarity(start: np.ndarray, end: np.ndarray) -> np.ndarray | None:
    if len(start) < LEAST:
        return None
    found, agree = cv2.estimateAffinePartial2D(
        start, end, method=cv2.RANSAC, ransacReprojThreshold=NEAR_PX
    )
    if found is None or agree.sum() < LEAST:
        return None
    return np.vstack([found, [0.0, 0.0, 1.0]])


def common_area(motion: np.ndarray, size: tuple[int, int]) -> float:
    """Which part of the larger of two views lies in the other one too, 0 to 1.

    Args:
      motion: (3, 3), between two frames of (width, height) `size`. If the second frame shows only
        the middle of the first one, closer, the part is that of the first one.
    """
    width, height = size
    corners = np.asarray([[0, 0], [width, 0], [width, height], [0, height]], float)
    moved = corners @ motion[:2, :2].T + motion[:2, 2]
    area, _ = cv2.intersectConvexConvex(corners.astype(np.float32), moved.astype(np.float32))
    larger = width * height * max(1.0, abs(np.linalg.det(motion[:2, :2])))
    return float(min(1.0, area / larger))


def detail_ratio(first: SmallFrame, second: SmallFrame, motion: np.ndarray) -> float:
    """How much more detail the second frame shows of what both show; above 1 if it is sharper.

    What only one of the frames shows does not count, so a frame does not look sharp because it
    shows a richer part of the scene.

    Args:
      motion: float64 (3, 3), from the first frame to the second.
    """
    warp = motion[:2]
    moved = cv2.warpAffine(first.detail, warp, second.size)
    both = cv2.warpAffine(np.ones_like(first.detail), warp, second.size) > 0.999
    mine, other = float(second.detail[both].sum()), float(moved[both].sum())
    return mine / other if other > 0 else float(mine > 0)
