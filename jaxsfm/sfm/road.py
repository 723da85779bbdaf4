"""The road from matches to models, step by step.

`walk` has all steps but the first two, which describe and match the photos and turn those that are
stored sideways (`jaxsfm.runs.run_photos`). Each step is a function that is described where it is
written. A step in `Step` can be skipped by name, which says what it is worth (`jaxsfm bench ledger
--without STEP`). `reconstruct` walks the road for those who have their own matches.
"""

import contextlib
import logging
import shutil
import tempfile
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.io.work_folder import WorkFolder
from jaxsfm.options import Step
from jaxsfm.sfm.mapped_stage import (
    MatchedPhotos,
    StageCache,
    VerifiedStage,
    map_trusted,
    mapper_of,
    matched_photos,
    verify_matches,
)
from jaxsfm.sfm.mapping import MappedModels, Mapper
from jaxsfm.sfm.refined_stage import Reconstructed, refine_selected
from jaxsfm.sfm.register.lost import MatchLost, register_lost
from jaxsfm.sfm.selected_stage import select_models

logger = logging.getLogger("jaxsfm")


class Watch(NamedTuple):
    """Who is told how far the road has been walked."""

    stage: Callable[[str], AbstractContextManager[None]] = lambda _: contextlib.nullcontext()
    """Called with the name of each stage; the block that it opens is the stage."""
    on_image: Callable[[], None] = lambda: None
    """Called for every photo that the mapper registers."""
    on_pass: Callable[[], None] = lambda: None
    """Called after every pass of the refinement."""


def walk(
    given: MatchedPhotos,
    kept: StageCache,
    database: Path,
    *,
    without: Collection[Step] = (),
    match_lost: MatchLost | None = None,
    watch: Watch | None = None,
) -> Reconstructed:
    """Make models of photos that were described and matched.

    Args:
      kept: stages of earlier runs, which are used again where they hold. New ones are kept there.
      database: where to write COLMAP's database; a file there is replaced.
      without: steps to skip.
      match_lost: matches photos that have no place with photos that have one, at full size. None:
        the matches that are given have to do.

    Raises:
      UserError: COLMAP fails.
    """
    watch = watch or Watch()
    with watch.stage("mapping"):
        # 3. Let COLMAP verify each pair. Photos from one place give no model.
        verified = verify_matches(given, kept)
        if verified.figures.one_place:
            shutil.copyfile(verified.pairs.database, database)
            return Reconstructed.nothing(verified.figures)
        mapper = mapper_of(given, verified)
        # 4. Trust the pairs on which most others agree.
        trust = mapper.trust_votes()
        # 5. Map them, and ask whether the photos agree with the models.
        first = map_trusted(given, verified, trust, "mapped", kept, watch.on_image)
        # 6. Map once more, if something speaks against the models or many photos are left out.
        second = None
        if "remap" not in without:
            second = _remap(given, verified, mapper, first, kept)
        # 7. Keep the better mapping, and split it where photos still contradict each other.
        # 8. Look for second places of photos.
        selected = select_models(given, verified, (first, second), kept, without=without)
    with watch.stage("refinement"):
        # 9. Move the keypoints to a fraction of a pixel.
        if "refine" in without:
            given = given.unrefined()
        made = refine_selected(given, verified, selected, database, kept, watch.on_pass)
    if "register" in without or given.config.refinement is None:
        return made
    # 10. Register the photos that have no place. The verdict follows from the checks.
    with watch.stage("registration"):
        return register_lost(given, selected, made, kept, match_lost)


def _remap(
    given: MatchedPhotos,
    verified: VerifiedStage,
    mapper: Mapper,
    first: MappedModels,
    kept: StageCache,
) -> MappedModels | None:
    """A second mapping; None if nothing calls for one.

    Photos that contradict each other, or their neighbours, call for other pairs. If more photos
    were left out than `jaxsfm.colmap.mapper.complete` allows, they call for more effort with the
    same pairs.
    """
    if not given.config.checked:
        return None
    trust, why = None, ""
    if first.contradicted() or first.apart(mapper.following()):
        trust, why = mapper.trust_for_remapping(first), "photos contradict the model"
    if trust is None:
        trust, why = mapper.trust_thoroughly(first), "the model lacks photos"
    if trust is None:
        return None
    logger.info("%s; mapping once more", why)
    return map_trusted(given, verified, trust, "remapped", kept)


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
