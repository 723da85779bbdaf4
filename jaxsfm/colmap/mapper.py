"""COLMAP's mappers: from verified pairs to models, with further attempts if images are left out.

Every model that the mapper makes is kept. The one with most images is the best; the others are
parts of the scene that nothing connects to it.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pycolmap

from jaxsfm.colmap.database import read_images
from jaxsfm.colmap.map_options import (
    MapOptions,
    global_options,
    incremental_options,
    narrowest_angle_deg,
)
from jaxsfm.colmap.model_images import ordered, registered
from jaxsfm.colmap.native import native
from jaxsfm.colmap.two_views import TwoView
from jaxsfm.io.pairs import Pair, component_of
from jaxsfm.options import Mapper

MISSING = 0.1
"""If at most this share of the connected images is left out, the mapper is not started again. One
image of ten lacks matches rather than a better start, and new starts take two more runs."""
MANY, MISSING_OF_MANY = 40, 0.5
"""If more images are connected than the first number, the second one is the share that may be left
out. In a collection many photos always are, and each further run takes minutes: on *statue* with
masks the first run registers 109 of 135 photos, and three more 102, 18 and 2."""
MAX_RETRIES = 2
"""Number of further initial pairs that are tried if the mapper's own choice leaves out images."""


@dataclasses.dataclass(frozen=True, kw_only=True)
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


def _complete(
    models: list[pycolmap.Reconstruction], pairs: list[Pair], missing: float = MISSING
) -> bool:
    """Whether the best model has the images that a chain of pairs connects to it, all but a share
    of `missing` (of many images, of `MISSING_OF_MANY`)."""
    if not models:
        return not pairs
    names = registered(models[0])
    connected = component_of(names, pairs)
    most = MISSING_OF_MANY if len(connected) > MANY else missing
    return len(connected - names) <= most * len(connected)


class Mapped(NamedTuple):
    """Models, and how they came about."""

    models: list[pycolmap.Reconstruction]
    """The one with most registered images first."""
    attempts: list[Attempt]
    """All runs of the mapper."""


class Start(NamedTuple):
    """How a run of the mapper begins."""

    pair: Pair | None = None
    """The pair that it starts from; None: its own choice."""
    names: Sequence[str] = ()
    """Of the images that it may use; none: all. For the incremental mapper."""


USUAL_START = Start()
"""From a pair of the mapper's own choice, with all images."""


def run_mapper(
    database: Path,
    options: MapOptions,
    start: Start = USUAL_START,
    on_image: Callable[[], None] = lambda: None,
) -> list[pycolmap.Reconstruction]:
    """The models of one run of COLMAP's mapper, the one with most images first.

    Args:
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
        p.image_names = list(start.names)
        if options.draft and images:
            angle = narrowest_angle_deg((camera for _, camera in images.values()), options.scale)
            p.triangulation.min_angle = p.mapper.filter_min_tri_angle = angle
        if start.pair is not None:
            p.init_image_id1, p.init_image_id2 = (images[name][0] for name in start.pair)
            p.multiple_models = (
                False  # otherwise COLMAP starts every model from this pair, 50 times
            )
            p.mapper.init_min_num_inliers = 30
            p.mapper.init_min_tri_angle = 4.0
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
        return ordered(list(found.values()))


MapperRun = Callable[[Path, MapOptions, Start, Callable[[], None]], "list[pycolmap.Reconstruction]"]
"""What `run_mapper` does, for a database that does not change while models are made from it."""


def build_models(
    database: Path,
    two_views: Mapping[Pair, TwoView],
    options: MapOptions,
    *,
    on_image: Callable[[], None] = lambda: None,
) -> Mapped:
    """Map a verified database, again and again if images are left out.

    Args:
      on_image: called for every image that the incremental mapper registers.

    Raises:
      UserError: COLMAP failed.
    """
    first = first_models(database, options, on_image=on_image)
    return with_left_out_images(first, database, two_views, options, on_image=on_image)


def first_models(
    database: Path,
    options: MapOptions,
    *,
    names: Sequence[str] = (),
    on_image: Callable[[], None] = lambda: None,
    run: MapperRun | None = None,
) -> Mapped:
    """Run the mapper once; see `build_models`.

    Args:
      names: of the images that the incremental mapper may use; by default all.
      run: runs the mapper, or gives what an earlier run gave; None: `run_mapper`.
    """
    models = (run or run_mapper)(database, options, Start(names=names), on_image)
    return Mapped(models, [_attempt(options.mapper, None, models)])


def with_left_out_images(
    first: Mapped,
    database: Path,
    two_views: Mapping[Pair, TwoView],
    options: MapOptions,
    *,
    on_image: Callable[[], None] = lambda: None,
    run: MapperRun | None = None,
) -> Mapped:
    """Start the mapper again if its first run found no model or left out connected images.

    Images are connected if verified pairs join them to the best model. If a draft leaves out one of
    them, the incremental mapper is run with all that it does otherwise. After that, at most
    `MISSING` of them may be left out; of more than `MANY` images, `MISSING_OF_MANY` in either case.
    Then it is started from other initial pairs (`initial_pairs`, each image once, with lower
    demands). If there is still no model, the global mapper is tried. An attempt that registers more
    images replaces the former ones, except for models of other images.

    Args:
      run: runs the mapper, or gives what an earlier run gave; None: `run_mapper`.

    Returns:
      `first` itself if nothing was tried.

    Raises:
      UserError: COLMAP failed.
    """
    run = run or run_mapper
    models, attempts = first.models, list(first.attempts)
    pairs = sorted(two_views)
    if options.mapper == "incremental":
        starts: list[Pair | None] = [*_apart(initial_pairs(two_views))[:MAX_RETRIES]]
        if options.draft:
            starts.insert(0, None)
            options = dataclasses.replace(options, draft=False)
        for pair in starts:
            if _complete(models, pairs, MISSING if pair else 0):
                continue
            other = run(database, options, Start(pair), on_image)
            attempts.append(_attempt("incremental", pair, other))
            if other and (not models or other[0].num_reg_images() > models[0].num_reg_images()):
                apart = [m for m in models if not registered(m) <= registered(other[0])]
                models = ordered([other[0], *apart])
        if not models and pairs:
            options = dataclasses.replace(options, mapper="global")
            other = run(database, options, USUAL_START, on_image)
            attempts.append(_attempt("global", None, other))
            models = other
    return Mapped(models, attempts) if len(attempts) > len(first.attempts) else first


def _apart(pairs: Iterable[Pair]) -> list[Pair]:
    """Those of the pairs that share no image with one before them."""
    found: list[Pair] = []
    used: set[str] = set()
    for pair in pairs:
        if not used & set(pair):
            used |= set(pair)
            found.append(pair)
    return found


def _attempt(mapper: Mapper, pair: Pair | None, models: list[pycolmap.Reconstruction]) -> Attempt:
    return Attempt(
        mapper=mapper, initial_pair=pair, registered=[m.num_reg_images() for m in models]
    )
