"""`jaxsfm frames`: the frames of a video that are worth reconstructing, written to a folder."""

from pathlib import Path

import tyro


def frames(
    video: tyro.conf.Positional[Path],
    *,
    out: Path,
    overlap: float = 0.8,
    most: int | None = None,
) -> int:
    """Choose frames of a video: the sharpest one of each stretch of the camera's way.

    For example
        $ jaxsfm frames VIDEO.mp4 --out FRAMES
        $ jaxsfm frames VIDEO.mp4 --out FRAMES --overlap 0.9 --most 200
        $ jaxsfm reconstruct FRAMES --out OUT --pairs retrieval:20+sequential:6

    Args:
      video: The video file.
      out: A new or empty folder for the frames. Their names have the number of the frame in the
        video.
      overlap: The part of its view that a chosen frame has in common with the one before it, from
        0.2 to 0.98. More overlap gives more frames.
      most: The largest number of frames. If there are more, frames at equal steps of the camera's
        way are kept, with less overlap.
    """
    from jaxsfm.runs.video.frames import FrameOptions, frames_folder

    found = frames_folder(video, out, FrameOptions(overlap=overlap, most=most), progress=True)
    before = ", chosen before" if found.there else ""
    print(
        f"{len(found.names)} frames: {out} (neighbours have about {100 * found.common:.0f} % in "
        f"common{before})"
    )
    return 0
