"""Day and night scenes for `bench daynight`, from three layouts.

* Strecha sets: each image is turned to a synthetic night in its turn, so the ground truth is exact
  for any severity.
* Simple scenes: SCENE/day/*, SCENE/night/* and SCENE/reference (Strecha .camera files, or a COLMAP
  model whose image names, or their stems, are those of the photos). If all photos share a known
  camera, SCENE/intrinsics.txt holds it as MODEL:p1,p2,.. (COLMAP's pixels) or as a 3 x 3 matrix. It
  can also be a list of cameras (`jaxsfm.colmap.given_cameras.read_camera_list`).
* Aachen Day-Night (`jaxsfm.bench.aachen`), which has a folder images_upright.

A synthetic night is a day photo as a camera would see it under a few lamps. It is a model and no
real night, so every result made with it is called `synthetic`. Its steps are:

1. Light: from severity 0 to 1 the day fades into a dim bluish ambience with a few lamps. Each lamp
   has its colour, its reach and a glare.
2. Blur of 0.3 px per unit of severity, because the exposure is longer.
3. Exposure: the brightest hundredth saturates; a pixel at saturation holds 20 000 electrons at
   severity 0 and a tenth of that per unit. Photon noise is Poisson, read noise 2 electrons.
4. Gain: the gain ends at 100 electrons for full scale, so from severity 2.3 on the image gets
   darker. At severity 5 a pixel holds less than one electron, and only read noise is left.
5. Encoding with gamma 2.2 and 8 bits, then optionally a camera's denoising and JPEG.
"""

import shutil
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.bench.inputs import check_root, choose_sets, strecha_intrinsics, usable_image
from jaxsfm.bench.model_options import DayNightOptions
from jaxsfm.bench.synthetic import write_photo
from jaxsfm.colmap.given_cameras import parse_cameras, parse_intrinsics
from jaxsfm.colmap.intrinsics import MODELS, KnownCameras, check_fits
from jaxsfm.colmap.poses import Poses, read_poses
from jaxsfm.core.night import (
    AMBIENT,
    BLUR_PX,
    FULL_WELL,
    GAMMA,
    LAMPS,
    MIN_FULL_SCALE,
    NUM_LAMPS,
    READ_NOISE,
    SATURATED_SHARE,
)
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile, inspect_image, read_image
from jaxsfm.io.photo_folder import find_images
from jaxsfm.sfm.evaluation import pair_names

PHOTOS = "images_upright"
"""The folder of Aachen's photos."""
NIGHT = "night/"


class Subset(NamedTuple):
    """The photos of one reconstruction: day photos and one night photo."""

    day: list[str]
    night: str


class Scene(NamedTuple):
    """Photos of one place, and the subsets of them that are reconstructed."""

    folder: Path
    """The photos' folder; their names are paths below it."""
    images: dict[str, ImageFile]
    subsets: list[Subset]
    truth: Poses
    """Reference poses by the photos' names; a photo without one is only counted as registered."""
    camera: KnownCameras | None
    """The known cameras; None if they are guessed and refined."""
    synthetic: bool


def synthetic_scene(folder: Path, target: Path, options: DayNightOptions) -> Scene:
    """Write a Strecha set below `target`, with each image also at night (`night/NAME.png`).

    Subset k holds image k at night and all others by day.
    """
    poses = read_poses(folder, option="--root")
    day = [name for name in find_images(folder / "images") if "/" not in name]
    (target / NIGHT).mkdir(parents=True, exist_ok=True)
    images, truth, subsets = {}, {}, []
    stored = pair_names(day, poses)
    for name in day:
        shutil.copyfile(folder / "images" / name, target / name)
        image = inspect_image(target / name, name=name)
        rgb = read_image(image, max_size=max(image.size)).rgb
        # The nights of a scene differ, and they do not depend on which other sets are run.
        dark = synthetic_night(
            rgb,
            severity=options.severity,
            seed=(options.seed + zlib.crc32(f"{folder.name}/{name}".encode())) % 2**32,
        )
        night = f"{NIGHT}{Path(name).stem}.png"
        write_photo(target / night, dark)
        images[name], images[night] = image, inspect_image(target / night, name=night)
        if name in stored:
            truth[name] = truth[night] = poses[stored[name]]
        subsets.append(Subset([other for other in day if other != name], night))
    camera = parse_intrinsics(strecha_intrinsics(folder)[0])
    return Scene(target, images, subsets, truth, camera, True)


def _known_camera(path: Path, images: dict[str, ImageFile]) -> KnownCameras | None:
    """Read cameras from a file with MODEL:p1,p2,.., a 3 x 3 matrix or a list; None without it."""
    if not path.is_file():
        return None
    try:
        text = path.read_text(encoding="utf-8").strip()
        found = parse_cameras(text if text.partition(":")[0] in MODELS else str(path))
    except (OSError, UnicodeDecodeError, UserError) as error:
        raise _of_root(path, error) from error
    check_cameras(found, images, path)
    return found


def check_cameras(known: KnownCameras, images: dict[str, ImageFile], path: Path) -> None:
    """Raise UserError, which names a path, unless cameras are those of images."""
    try:
        check_fits(known, {name: image.size for name, image in images.items()})
    except UserError as error:
        raise _of_root(path, error) from error


def _of_root(path: Path, error: Exception) -> UserError:
    """An error in what was found below `--root`, not in `--intrinsics`, which was not given."""
    why = str(error).removeprefix("--intrinsics").strip(" :")
    return UserError(f"--root: {path}: {why}")


def simple_scene(folder: Path) -> Scene:
    """Read a simple scene; each subset is one night photo with all day photos."""
    names = {
        part: [f"{part}/{name}" for name in find_images(folder / part)] for part in ("day", "night")
    }
    images = inspected(folder, [n for part in names.values() for n in part])
    truth = reference_of(folder.name, images, read_poses(folder / "reference", option="--root"))
    if sum(name in truth for name in names["day"]) < 3:
        raise UserError(
            f"--root: {folder / 'reference'} has fewer than 3 of the day photos (by name, or by a "
            "name without suffix that only one photo has)"
        )
    camera = _known_camera(folder / "intrinsics.txt", images)
    subsets = [Subset(names["day"], night) for night in names["night"]]
    return Scene(folder, images, subsets, truth, camera, False)


def inspected(folder: Path, names: Sequence[str]) -> dict[str, ImageFile]:
    """The photos in a folder, checked.

    Raises:
      UserError: one of them cannot be used.
    """
    return {name: usable_image(folder / name, name=name) for name in names}


def reference_of(scene: str, images: dict[str, ImageFile], poses: Poses) -> Poses:
    """The poses of those photos that a reference has, by the photos' names.

    Raises:
      UserError: the reference is empty.
    """
    if not poses:
        raise UserError(f"--root: the reference of {scene} has no poses")
    return {name: poses[other] for name, other in pair_names(list(images), poses).items()}


def find_scenes(root: Path, names: Sequence[str] | None) -> dict[str, Path]:
    """The folders of the scenes below `root` by name. Aachen Day-Night is one scene.

    Args:
      names: the names of the scenes; None stands for all.

    Raises:
      UserError: there is no scene, or none with one of the names.
    """
    check_root(root)
    root = root.resolve()  # so that it has a name
    if (root / PHOTOS).is_dir():
        found = {root.name: root}
    else:
        found = {path.parent.name: path.parent for path in root.glob("*/night") if path.is_dir()}
        found |= {path.parents[1].name: path.parents[1] for path in root.glob("*/images/K.txt")}
    if not found:
        raise UserError(
            f"--root {root}: no scenes in it (SCENE/day and SCENE/night, Strecha sets, or Aachen's "
            f"{PHOTOS})"
        )
    return {folder.name: folder for folder in choose_sets(found, names, root)}


def check_strecha(folder: Path) -> None:
    """Raise UserError if `synthetic_scene` cannot use the set."""
    strecha_intrinsics(folder)
    read_poses(folder, option="--root")
    for name in find_images(folder / "images"):
        usable_image(folder / "images" / name)


def is_strecha(folder: Path) -> bool:
    """Whether the folder is a Strecha set, for which nights are made."""
    return (folder / "images" / "K.txt").is_file()


def _lamp_light(shape: tuple[int, int], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Light on the surfaces and glare in front of them, float64 (h, w, 3); 1 is daylight."""
    height, width = shape
    diagonal = np.hypot(height, width)
    y, x = np.mgrid[:height, :width]
    light = np.broadcast_to(np.asarray(AMBIENT), (height, width, 3)).copy()
    glare = np.zeros((height, width, 3))
    for _ in range(NUM_LAMPS):
        at = rng.uniform([0.05, 0.05], [0.95, 0.75]) * (width, height)
        reach = rng.uniform(0.06, 0.16) * diagonal
        colour = np.asarray(LAMPS)[rng.integers(len(LAMPS))] * rng.uniform(0.4, 1.0)
        square = (x - at[0]) ** 2 + (y - at[1]) ** 2
        light += (1 / (1 + square / reach**2) ** 2)[..., None] * colour
        glare += np.exp(-square / (2 * (0.006 * diagonal) ** 2))[..., None] * colour
    return light, glare


def synthetic_night(
    rgb: np.ndarray, *, severity: float, seed: int, denoise: bool = True, jpeg: bool = True
) -> np.ndarray:
    """A photo at a synthetic night, uint8 (h, w, 3) RGB.

    Args:
      rgb: uint8 (h, w, 3), a day photo.
      severity: 0 is the photo itself, 1 a clean night, 2 noisy, 3 dark, 5 nothing but noise.
      seed: seed of the lamps' places and of the noise.
      denoise: whether the camera removes noise.
      jpeg: whether the camera stores JPEG.

    Raises:
      ValueError: `severity` is negative, or `rgb` is not such an image.
    """
    if severity < 0:
        raise ValueError(f"severity must be at least 0; got {severity}")
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"rgb must be uint8 (h, w, 3); got {rgb.dtype} {rgb.shape}")
    if severity == 0:
        return rgb.copy()
    rng = np.random.default_rng(seed)
    light, glare = _lamp_light(rgb.shape[:2], rng)
    dusk = min(severity, 1.0)
    radiance = (rgb / 255.0) ** GAMMA * ((1 - dusk) + dusk * light) + dusk * glare
    radiance = cv2.GaussianBlur(radiance, (0, 0), BLUR_PX * severity)
    white = (1 - dusk) + dusk * float(np.quantile(radiance.max(2), 1 - SATURATED_SHARE))
    full = FULL_WELL * 10.0**-severity
    electrons = rng.poisson(np.minimum(radiance / max(white, 1e-6), 1.0) * full)
    electrons = electrons + rng.normal(0.0, READ_NOISE, rgb.shape)
    signal = np.clip(electrons / max(full, MIN_FULL_SCALE), 0.0, 1.0)
    image = np.round(255 * signal ** (1 / GAMMA)).astype(np.uint8)
    if denoise:
        strength = float(np.clip(5 * severity, 3, 12))
        image = cv2.fastNlMeansDenoisingColored(image, None, strength, strength, 5, 11)
    if jpeg:
        quality = int(np.clip(95 - 10 * severity, 50, 95))
        ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        assert ok
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert decoded is not None
        image = np.ascontiguousarray(decoded[..., ::-1])
    return image
