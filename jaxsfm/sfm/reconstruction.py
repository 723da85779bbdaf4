"""From matches to models: verification, mapping with the view graph and the check, refinement."""

import tempfile
from collections.abc import Mapping
from pathlib import Path

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.sfm.mapped_stage import StageCache, matched_photos
from jaxsfm.sfm.refined_stage import Reconstructed
from jaxsfm.sfm.road import walk


def reconstruct(
    images: list[ImageFile],
    matches: Mapping[Pair, PairResult],
    database: Path,
    *,
    config: Config,
    cameras: Cameras | None = None,
    options: MapOptions | None = None,
) -> Reconstructed:
    """Make COLMAP models from verified matches: mapping of trusted pairs, check, refinement.

    Pixel thresholds are multiplied by `Photos.median_scale`. Points get the colours of the photos.

    Args:
      matches: the result of `match`.
      database: where to write the COLMAP database; a file there is replaced.
      config: the one that the matches were made with. Its `view_graph`, `checked` and `refinement`
        switch those parts on.
      cameras: what is known and assumed of the cameras; by default no camera is known.
      options: of the mapper. By default it is incremental, and refines the intrinsics unless the
        cameras are known.

    Raises:
      UserError: the cameras do not fit the images, or COLMAP fails.
    """
    given = matched_photos(
        images,
        matches,
        config=config,
        described=config,
        cameras=cameras or Cameras(),
        options=options,
    )
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        stages = StageCache(WorkFolder(Path(scratch), {}), "")
        return walk(given, stages, database)
