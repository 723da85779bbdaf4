"""How the pixels of a photo are stored, and how the photo is seen upright.

Cameras store the rows of their sensor, and note in EXIF how to turn them. The codes of this note
are used for all orientations, also for those that were found by trying. Photos are described
upright, because VGG does not recognise turned content. All coordinates that are written are those
of the pixels as they are stored.

Source: CIPA DC-008 (EXIF 2.32), tag 0x0112.
"""

import numpy as np

UPRIGHT = 1
"""The photo is stored as it is seen."""
CODES = range(1, 9)
QUARTERS = (1, 6, 3, 8)
"""The code of a photo that is seen upright after 0, 1, 2, 3 quarter turns clockwise."""
_TRANSPOSED, _MIRRORED_X, _MIRRORED_Y = {5, 6, 7, 8}, {2, 3, 7, 8}, {3, 4, 6, 7}


def checked(code: object) -> int:
    """The code, or `UPRIGHT` for a value that is no code: some programs write 0."""
    return code if isinstance(code, int) and code in CODES else UPRIGHT


def upright_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """(width, height) of a photo when it is seen upright, from its size as stored."""
    return (size[1], size[0]) if orientation in _TRANSPOSED else size


def upright(stored: np.ndarray, orientation: int) -> np.ndarray:
    """Turn the pixels (h, w, ...) of a stored photo so that it is upright; the memory is shared."""
    if orientation in _MIRRORED_X:
        stored = stored[:, ::-1]
    if orientation in _MIRRORED_Y:
        stored = stored[::-1]
    return stored.swapaxes(0, 1) if orientation in _TRANSPOSED else stored


def to_stored(size: tuple[int, int], orientation: int) -> np.ndarray:
    """The float64 matrix (3, 3) that maps pixels of the upright photo to those of the stored one.

    Args:
      size: (width, height) as stored. The centre of the top-left pixel is (0, 0).
    """
    matrix = np.eye(3)
    if orientation in _TRANSPOSED:
        matrix = matrix[[1, 0, 2]]
    for axis, mirrored in enumerate((_MIRRORED_X, _MIRRORED_Y)):
        if orientation in mirrored:
            matrix[axis] = (size[axis] - 1) * np.eye(3)[2] - matrix[axis]
    return matrix


def stored_axes(orientation: int) -> np.ndarray:
    """The rotation (3, 3) from the camera axes of the upright photo to those of the stored one.

    Raises ValueError for a mirrored photo, which has no such rotation.
    """
    if orientation not in QUARTERS:
        raise ValueError(f"orientation must be one of {QUARTERS}; got {orientation}")
    axes = np.eye(3)
    axes[:2, :2] = to_stored((1, 1), orientation)[:2, :2]
    return axes


def stored_points(upright_xy: np.ndarray, size: tuple[int, int], orientation: int) -> np.ndarray:
    """Points (n, 2) of the upright photo, in pixels of the stored one; `size` as in `to_stored`."""
    matrix = to_stored(size, orientation)
    return upright_xy @ matrix[:2, :2].T + matrix[:2, 2]


def turned(orientation: int, quarters: int) -> int:
    """The code of a photo whose upright picture is turned by further quarter turns clockwise."""
    by_matrix = {to_stored((1, 1), code).tobytes(): code for code in CODES}
    # With a size of 1 x 1 pixel the matrices are those of the turns alone.
    matrix = to_stored((1, 1), orientation) @ to_stored((1, 1), QUARTERS[quarters % 4])
    return by_matrix[matrix.tobytes()]


def quarters_between(before: int, after: int) -> int:
    """The quarter turns clockwise, 0 .. 3, that lead from one code to another (`turned`).

    Raises ValueError if the codes differ by a mirror.
    """
    for quarters in range(4):
        if turned(before, quarters) == after:
            return quarters
    raise ValueError(f"codes must differ by a turn; got {before} and {after}")
