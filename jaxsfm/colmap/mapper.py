"""COLMAP's mappers: from verified pairs to models, and from known poses to all points.

Every model that the mapper makes is kept. The one with most images is the best; the others are
parts of the scene that nothing connects to it.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import pycolmap

from jaxsfm.colmap.database import read_images
from jaxsfm.colmap.map_options import (
    MapOptions,
    global_options,
    incremental_options,
    narrowest_angle_deg,
)
from jaxsfm.colmap.native import native
from jaxsfm.colmap.reconstruction import ordered, registered
from jaxsfm.colmap.two_views import TwoView
from jaxsfm.io.pairs import Pair, component_of
from jaxsfm.options import Mapper

MISSING = 0.1
"""If at most this share of the connected images is left out, the mapper is not started again. One
image of ten lacks matches rather than a better start."""
MANY, MISSING_OF_MANY = 40, 0.5
"""If more images are connected than the first number, the second one is the share that may be left
out. In a collection many photos always are, and each further run takes minutes: on *statue* with
masks the first run registers 109 of 135 photos, and three more 102, 18 and 2."""
LOW_ANGLE_DEG, LOW_INLIERS = 4.0, 30
"""Where no pair fulfils COLMAP's demands on the first one (16 deg and 100 inliers, which COLMAP
halves twice by itself), the mapper starts with these. Of the first 50 frames of a video of
*kitchen*, the rays of a pair meet at 1 deg (median): none is registered with COLMAP's demands, and
all are with these, their rotations right within 1.1 deg (median) before the refinement."""
MAX_RETRIES = 2
"""Number of further initial pairs that are tried if the mapper's own choice leaves out images."""
MIN_MODEL_POINTS = 10
"""A model with fewer points is not refined."""


@dataclasses.dataclass(frozen=True)
class Attempt:
    """One run of a mapper."""

    mapper: Mapper
    initial_pair: Pair | None
    """The pair that mapping started from; None: the mapper's own choice."""
    registered: list[int]
    """Number of images of every model, the largest first."""


def initial_pairs(two_views: Mapping[Pair, TwoView]) -> list[Pair]:
    """Pairs to start mapping from, the best first: with many inliers, a wide angle, several planes.

    One plane leaves the relative pose ambiguous, and a narrow angle leaves the depth uncertain:
    COLMAP asks for 16 degrees at first.
    """

    def score(view: TwoView) -> float:
        angle = min(view.tri_angle_deg / 16.0, 1.0)
        return view.geometry.num_inliers * angle * (0.25 if view.planar else 1.0)

    return sorted(
        (p for p, v in two_views.items() if v.geometry.rotation is not None and score(v) > 0),
        key=lambda p: (-score(two_views[p]), p),
    )


def complete(models: Sequence[pycolmap.Reconstruction], pairs: Collection[Pair]) -> bool:
    """Whether the best model has the images that a chain of pairs connects to it, all but a share
    of `MISSING` (of many images, of `MISSING_OF_MANY`)."""
    if not models:
        return not pairs
    names = registered(models[0])
    connected = component_of(names, pairs)
    most = MISSING_OF_MANY if len(connected) > MANY else MISSING
    return len(connected - names) <= most * len(connected)


def run_mapper(
    database: Path,
    options: MapOptions,
    *,
    start: Pair | None = None,
    names: Sequence[str] = (),
    on_image: Callable[[], None] = lambda: None,
) -> list[pycolmap.Reconstruction]:
    """The models of one run of COLMAP's mapper, the one with most images first.

    Args:
      start: the pair that it starts from, with lower demands; None: its own choice.
      names: of the images that the incremental mapper may use; none: all.
      on_image: called for every image that the incremental mapper registers.

    Raises:
      UserError: COLMAP failed.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        if options.mapper == "global":
            found = native(
                lambda _: pycolmap.global_mapping(
                    database, scratch, scratch, global_options(options)
                ),
                database,
                grace_s=1,  # it cannot be cancelled
            )
            return ordered(list(found.values()))
        p, images = incremental_options(options), read_images(database)
        p.image_names = list(names)
        if options.draft and images:
            angle = narrowest_angle_deg((camera for _, camera in images.values()), options.scale)
            p.triangulation.min_angle = p.mapper.filter_min_tri_angle = angle
        if start is not None:
            p.init_image_id1, p.init_image_id2 = (images[name][0] for name in start)
            p.multiple_models = (
                False  # otherwise COLMAP starts every model from this pair, 50 times
            )
            _demand_little(p)

        def incremental() -> list[pycolmap.Reconstruction]:
            found = native(
                lambda token: pycolmap.incremental_mapping(
                    database,
                    scratch,
                    scratch,
                    p,
                    initial_image_pair_callback=lambda: (on_image(), on_image()) and None,
                    next_image_callback=on_image,
                    cancellation_token=token,
                ),
                database,
            )
            return list(found.values())

        found = incremental()
        if not found and start is None:
            _demand_little(p)
            found = incremental()
        return ordered(found)


def _demand_little(p: pycolmap.IncrementalPipelineOptions) -> None:
    """Let the mapper start from a pair with few inliers, whose rays meet at small angles."""
    p.mapper.init_min_num_inliers, p.mapper.init_min_tri_angle = LOW_INLIERS, LOW_ANGLE_DEG


def build_models(
    database: Path, two_views: Mapping[Pair, TwoView], options: MapOptions
) -> list[pycolmap.Reconstruction]:
    """The models of COLMAP's mapper for a verified database, as COLMAP makes them at its best.

    If the incremental mapper leaves out images (`complete`), it is started again from other pairs
    than its own choice (`initial_pairs`, each image once, with lower demands). A run that registers
    more images replaces the former one, except for models of other images.

    Raises:
      UserError: COLMAP failed.
    """
    models, pairs = run_mapper(database, options), sorted(two_views)
    starts = _apart(initial_pairs(two_views))[:MAX_RETRIES]
    for pair in starts if options.mapper == "incremental" else ():
        if complete(models, pairs):
            break
        other = run_mapper(database, options, start=pair)
        if other and (not models or other[0].num_reg_images() > models[0].num_reg_images()):
            apart = [m for m in models if not registered(m) <= registered(other[0])]
            models = ordered([other[0], *apart])
    return models


def _apart(pairs: Iterable[Pair]) -> list[Pair]:
    """Those of the pairs that share no image with one before them."""
    found: list[Pair] = []
    used: set[str] = set()
    for pair in pairs:
        if not used & set(pair):
            used |= set(pair)
            found.append(pair)
    return found


def attempt_of(models: Sequence[pycolmap.Reconstruction], mapper: Mapper) -> Attempt:
    """What a run of a mapper has made, which started from a pair of its own choice."""
    return Attempt(mapper, None, [model.num_reg_images() for model in models])


def with_all_points(
    model: pycolmap.Reconstruction, database: Path, options: MapOptions
) -> pycolmap.Reconstruction:
    """A copy of a model with the points of all verified matches of its images.

    COLMAP triangulates the points, joins them to tracks, adjusts them, and drops observations that
    are too far off. Poses and cameras stay.

    If COLMAP finds fewer than `MIN_MODEL_POINTS`, the model keeps those that it has. This happens
    to models of two to four photos with a wrong camera: a model of *statue*, in which one of three
    photos had a focal length of a million pixels, came back without its 839 points. Then nothing
    could speak against it.

    Args:
      database: with the images and keypoints of the model.

    Raises:
      UserError: COLMAP failed.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        whole = native(
            lambda token: pycolmap.triangulate_points(
                pycolmap.Reconstruction(model),  # it is changed in place
                database,
                scratch,
                scratch,
                clear_points=True,
                options=incremental_options(options),
                refine_intrinsics=False,
                cancellation_token=token,
            ),
            database,
        )
    if whole.num_points3D() < min(MIN_MODEL_POINTS, model.num_points3D()):
        return pycolmap.Reconstruction(model)
    return whole
