"""The rendered room as the photos and matches of a run, and models of some of its views."""

from collections.abc import Collection, Mapping
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from room_scene import SIZE, Room, camera, exact_tracks

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.reconstruction import part_of
from jaxsfm.config import Config, Refinement
from jaxsfm.io.images import inspect_image
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.mapped_stage import MatchedPhotos

NAMES = [f"{k}.png" for k in range(5)]
CONFIG = Config(max_size=max(SIZE), view_graph=True, checked=True, refinement=Refinement())


def model_with(scene: Room, numbers: Collection[int], *, every: int = 1) -> pycolmap.Reconstruction:
    """The exact model of these views, with each so-many-th point of the room."""
    use = scene.visible.copy()
    use[:, [k for k in range(5) if k not in numbers]] = False
    use[np.arange(len(use)) % every > 0] = False
    use[use.sum(1) < 2] = False
    model = Model(scene.views, exact_tracks(scene, use=use)).to_colmap()
    return part_of(model, [NAMES[k] for k in numbers])


def room_photos(
    folder: Path,
    scene: Room,
    matches: Mapping[Pair, PairResult],
    *,
    photos: Mapping[str, np.ndarray] | None = None,
    config: Config = CONFIG,
) -> MatchedPhotos:
    """The photos of the room with their matches and the known camera.

    Args:
      folder: where to write the photos.
      photos: instead of the room's, by name.
    """
    for name, gray in {**scene.images, **(photos or {})}.items():
        pixels = np.repeat(np.clip(np.round(gray), 0, 255).astype(np.uint8)[..., None], 3, 2)
        assert cv2.imwrite(str(folder / name), pixels)
    return MatchedPhotos(
        images=[inspect_image(folder / name) for name in NAMES],
        matches=matches,
        config=config,
        described=config,
        cameras=Cameras(known=Intrinsics(model="PINHOLE", params=tuple(camera().params))),
        options=MapOptions(refine_intrinsics=False, threads=1),
    )
