"""Known cameras as users write them: a K.txt, `MODEL:p1,p2,...`, or a list with a line for each
photo, checked before COLMAP sees them.

A K matrix counts pixels from the centre of the top-left one, as OpenCV does. The parameters of a
COLMAP model count them as COLMAP does, where that centre is (0.5, 0.5).
"""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from jaxsfm.colmap.intrinsics import MODELS, Intrinsics, KnownCameras
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import write_atomic
from jaxsfm.io.images import shown_name

ENCODING = "utf-8-sig"
"""With or without the mark that editors of Windows write first."""
SMALLEST_PX = 1e-3
"""A smaller skew is what the rounding of a decomposition leaves: no measurement sees it."""
ROUNDING = 1e-7
"""The last row of a matrix may be so far off: in a photo of 8000 pixels, it moves none by more than
`SMALLEST_PX`."""
_SIDE = r"([+-]?\d[\d.eE+-]*)"
_LINE = re.compile(rf"(.+?)\s+({'|'.join(MODELS)})\s+{_SIDE}\s+{_SIDE}\s+(.+)")
"""A line of a list of cameras."""


def _numbers(texts: list[str], where: str) -> list[float]:
    try:
        values = [float(text) for text in texts]
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error
    if not np.isfinite(values).all():
        raise UserError(f"{where}: the numbers must be finite; got {values}")
    return values


def _text_of(path: Path, where: str) -> str:
    try:
        return path.read_text(encoding=ENCODING)
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{where}: cannot be read as text") from error


def _from_matrix(text: str, where: str) -> Intrinsics:
    values = _numbers(text.replace(",", " ").split(), where)
    if len(values) != 9:
        raise UserError(f"{where}: expected the 9 numbers of a 3 x 3 matrix; got {len(values)}")
    (fx, skew, cx), (zero, fy, cy), last = np.reshape(values, (3, 3)).tolist()
    if not np.allclose(last, [0, 0, 1], rtol=0, atol=ROUNDING) or abs(zero) >= SMALLEST_PX:
        raise UserError(f"{where}: not a camera matrix (rows must be fx 0 cx, 0 fy cy, 0 0 1)")
    if abs(skew) >= SMALLEST_PX:
        raise UserError(f"{where}: skew must be 0; got {skew}")
    if fx <= 0 or fy <= 0:
        raise UserError(f"{where}: focal lengths must be positive; got {fx} and {fy}")
    return Intrinsics(model="PINHOLE", params=(fx, fy, cx + 0.5, cy + 0.5))


def parse_intrinsics(text: str) -> Intrinsics:
    """Read intrinsics from the path of a K.txt, or from `MODEL:p1,p2,...` (a COLMAP camera model).

    Raises UserError if the text is neither, or its numbers make no camera.
    """
    model, colon, params = text.partition(":")
    if not colon or model not in MODELS:
        path = Path(text)
        if path.is_file():
            where = f"--intrinsics {path}"
            return _from_matrix(_text_of(path, where), where)
        if colon and model.isupper():
            raise UserError(
                f"--intrinsics: unknown camera model {model!r}; one of {', '.join(MODELS)}"
            )
        shown = shown_name(text)
        raise UserError(f"--intrinsics {shown}: no such file, and not MODEL:p1,p2,...")
    where = f"--intrinsics {model}"
    values = _numbers(params.split(","), where)
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1)
    if len(values) != len(camera.params):
        raise UserError(
            f"{where}: expected {len(camera.params)} numbers ({camera.params_info}); "
            f"got {len(values)}"
        )
    for index in camera.focal_length_idxs():
        if values[index] <= 0:
            raise UserError(f"{where}: the focal length must be positive; got {values[index]}")
    return Intrinsics(model=model, params=tuple(values))


def parse_cameras(text: str) -> KnownCameras:
    """What `parse_intrinsics` reads, or the cameras of a list (`read_camera_list`) by photo."""
    path = Path(text)
    if not path.is_file():
        return parse_intrinsics(text)
    where = f"--intrinsics {path}"
    content = _text_of(path, where)
    if _is_matrix(content):
        return _from_matrix(content, where)
    found = _from_list(content, where)
    if not found:
        raise UserError(f"{where}: neither a 3 x 3 matrix nor a list of cameras")
    return found


def _is_matrix(text: str) -> bool:
    """Whether a text begins with a number, and has no line of a list."""
    try:
        float(text.replace(",", " ").split()[0])
    except (ValueError, IndexError):
        return False
    return not any(_LINE.fullmatch(line.strip()) for line in text.splitlines())


def read_camera_list(path: Path, option: str) -> dict[str, Intrinsics]:
    """Read the cameras of photos from lines of NAME MODEL WIDTH HEIGHT PARAMETERS.

    It is the list of queries that hloc and the benchmarks of visual localization use. A line that
    starts with # is a comment. A name may have blanks.

    Args:
      option: which option named the file, for the sentence of an error.

    Raises:
      UserError: a line is anything else, or gives a photo a second camera.
    """
    where = f"{option} {path}"
    return _from_list(_text_of(path, where), where)


def _from_list(text: str, where: str) -> dict[str, Intrinsics]:
    found: dict[str, Intrinsics] = {}
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        try:
            name, camera = _listed(line)
        except (ValueError, UserError) as error:
            why = str(error).removeprefix("--intrinsics ")
            raise UserError(
                f"{where}: line {number} is not NAME MODEL WIDTH HEIGHT PARAMETERS ({why}): "
                f"{line[:80]!r}"
            ) from error
        if found.setdefault(name, camera) != camera:
            raise UserError(f"{where}: line {number} is a second camera of {shown_name(name)}")
    return found


def write_camera_list(path: Path, known: Mapping[str, Intrinsics]) -> None:
    """Write cameras that say the size of their photos as a list that `read_camera_list` reads.

    Raises:
      UserError: a name cannot be read back from a line.
      ValueError: a camera does not say the size.
    """
    lines = []
    for name, camera in known.items():
        if name != name.strip() or name.startswith("#"):
            raise UserError(f"{name!r}: a list of cameras cannot hold this name")
        if camera.size is None:
            raise ValueError(f"the camera of {name} must have a size; got None")
        numbers = (*camera.size, *map(float, camera.params))
        lines.append(" ".join([name, camera.model, *map(str, numbers)]) + "\n")
    write_atomic(path, "".join(lines).encode())


def _listed(line: str) -> tuple[str, Intrinsics]:
    """The photo of a line, and its camera; ValueError or UserError if it is no such line."""
    match = _LINE.fullmatch(line)
    if match is None:
        raise ValueError("no camera model")
    name, model, width, height, params = match.groups()
    size = _side(width), _side(height)
    camera = parse_intrinsics(f"{model}:{','.join(params.split())}")
    return name, dataclasses.replace(camera, size=size)


def _side(text: str) -> int:
    """Whole pixels: tables that know one kind of number write 1024 as 1024.0. ValueError if not."""
    try:
        side = float(text)
    except ValueError:
        side = 0.0
    if not side.is_integer() or side < 1:
        raise ValueError(f"width and height must be whole numbers of pixels; got {text}")
    return int(side)


def listed_name(path: Path, known: Mapping[str, Intrinsics]) -> str | None:
    """The name under which a list has a photo: the longest one that its absolute path ends with."""
    absolute = path.absolute()
    ends = ("/".join(absolute.parts[k:]) for k in range(1, len(absolute.parts)))
    return next((name for name in (absolute.as_posix(), *ends) if name in known), None)
