"""What is said of a folder of photos before anything long starts. Nothing here stops a run."""

from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from jaxsfm.io.images import ImageFile, named, shown_name
from jaxsfm.sfm.check.model_check import MIN_VIEWS

MEASURED = 1000
"""The number of photos in the largest set that was measured (docs/guide/many-photos.md)."""
SCREENS = frozenset(
    [
        # Monitors and notebooks: VESA's sizes, and those of Apple's displays.
        *((1280, 720), (1280, 800), (1280, 1024), (1366, 768), (1440, 900), (1536, 864)),
        *((1600, 900), (1680, 1050), (1920, 1080), (1920, 1200), (2560, 1080), (2560, 1440)),
        *((2560, 1600), (2880, 1800), (3024, 1964), (3440, 1440), (3456, 2234), (3840, 2160)),
        *((5120, 2880),),
        # Phones and tablets, upright.
        *((750, 1334), (828, 1792), (1080, 1920), (1080, 2220), (1080, 2280), (1080, 2340)),
        *((1080, 2400), (1125, 2436), (1170, 2532), (1179, 2556), (1206, 2622), (1242, 2688)),
        *((1284, 2778), (1290, 2796), (1320, 2868), (1440, 2560), (1440, 2960), (1440, 3040)),
        *((1440, 3088), (1440, 3120), (1440, 3200), (1536, 2048), (1620, 2160), (1640, 2360)),
        *((1668, 2388), (2048, 2732)),
    ]
)
"""(width, height) of usual screens, pixels. A screenshot has this size, turned or not. So have many
frames of videos, so a picture of such a size is only asked about."""


def first_words(folder: Path, images: Sequence[ImageFile], videos: Iterable[str]) -> list[str]:
    """Sentences about a folder that is about to be reconstructed; most folders need none.

    Args:
      images: the photos that can be used.
      videos: the names of the video files among them, with '/' (`find_videos`).
    """
    return [*_number(folder, images), *_screenshots(images), *_videos(folder, images, videos)]


def _number(folder: Path, images: Sequence[ImageFile]) -> list[str]:
    if len(images) < MIN_VIEWS:
        return [
            f"{folder}: from {len(images)} photos comes a model that nothing can check; a third "
            "photo, a step to the side of the others, can confirm it or contradict it"
        ]
    if len(images) > MEASURED:
        return [
            f"{folder}: {len(images)} photos; the largest set that was measured has {MEASURED}. "
            "Try some hundred neighbouring photos first, in a folder of their own. Ctrl-C stops "
            "this run, and the same command continues it"
        ]
    return []


def is_like_a_screenshot(image: ImageFile) -> bool:
    """Whether a picture is a PNG of a screen's size, of which EXIF names no camera."""
    width, height = image.size
    on_screen = (width, height) in SCREENS or (height, width) in SCREENS
    return image.path.suffix.lower() == ".png" and not image.taken_with and on_screen


def _screenshots(images: Sequence[ImageFile]) -> list[str]:
    found = [image for image in images if is_like_a_screenshot(image)]
    if not found:
        return []
    names = named([image.name for image in found])
    width, height = found[0].size
    are, size = ("is", "a PNG") if len(found) == 1 else ("are", "PNG files")
    return [
        f"{names} {are} {size} of a screen's size ({width} x {height}) without a camera in EXIF: "
        "frames of a video are fine, but windows and buttons of a screenshot are no part of a "
        "scene; take such pictures out"
    ]


def _videos(folder: Path, images: Sequence[ImageFile], videos: Iterable[str]) -> list[str]:
    """What becomes of videos. A phone's live photo has a video of its own name, which adds
    nothing."""
    stems = {PurePosixPath(image.name).with_suffix("") for image in images}
    alone = [name for name in videos if PurePosixPath(name).with_suffix("") not in stems]
    if not alone:
        return []
    first = alone[0]
    frames = folder / f"{PurePosixPath(first).stem}-frames"
    return [
        f"{named(alone)}: videos among photos are not used. To use their frames as photos, type "
        f"jaxsfm frames '{shown_name(str(folder / first))}' --out '{shown_name(str(frames))}', "
        "and run the same command again"
    ]
