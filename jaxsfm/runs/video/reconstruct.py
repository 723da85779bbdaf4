"""A video to a COLMAP model: frames are chosen, and reconstructed as photos are."""

import dataclasses
import logging
from pathlib import Path

from jaxsfm.config import Config
from jaxsfm.io.pair_selection import chosen_pairs, many_frames
from jaxsfm.io.video import open_video
from jaxsfm.io.work_folder import FRAMES, lock_folder
from jaxsfm.report.run_report import RunReport
from jaxsfm.runs.reconstruct import reconstruct_folder
from jaxsfm.runs.run_options import RunOptions, check_options
from jaxsfm.runs.video.frames import frames_folder

logger = logging.getLogger("jaxsfm")


def reconstruct_video(video: Path, out: Path, *, config: Config, options: RunOptions) -> RunReport:
    """Reconstruct a video; otherwise as `jaxsfm.runs.reconstruct.reconstruct_folder`.

    The frames are chosen once and kept in `out`/frames, which is the run's folder of photos. Frames
    of this video that are there already, for example chosen with another overlap, are used as they
    are.

    Raises:
      UserError: the video or an option cannot be used. What was computed is kept.
    """
    check_options(options)
    with open_video(video):  # what is no video makes no folder
        pass
    with lock_folder(out):
        found = frames_folder(video, out / FRAMES, progress=options.progress)
    how = "have been chosen before" if found.there else "were chosen"
    logger.info("%d frames %s, in %s", len(found.names), how, out / FRAMES)
    pairs = chosen_pairs(options.pairs, len(found.names), many_frames(found.common))
    options = dataclasses.replace(options, pairs=pairs)
    return reconstruct_folder(out / FRAMES, out, config=config, options=options)
