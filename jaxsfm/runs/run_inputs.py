"""What a run is given besides the pixels of its photos. All of it is read and checked before the
work begins, which with panoramas takes minutes before the first photo is matched.
"""

import dataclasses
from collections.abc import Collection, Sequence

from jaxsfm.colmap.cameras import Cameras, rig_intrinsics
from jaxsfm.colmap.external_matches import ExternalMatches, read_external_matches
from jaxsfm.colmap.given_cameras import parse_cameras
from jaxsfm.colmap.intrinsics import used_cameras
from jaxsfm.config import Config
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pair_selection import PairSelection, parse_pair_selection, selected_pairs
from jaxsfm.io.pairs import Pair
from jaxsfm.io.relocalizer import Relocalizer
from jaxsfm.io.rig_config import Rig, check_prefixes
from jaxsfm.io.weights import Weights, chosen_weights
from jaxsfm.matching.retrieval import check_retrieval
from jaxsfm.runs.georeferencing import measured_positions
from jaxsfm.runs.panoramas import PanoramaPlan
from jaxsfm.runs.run_options import RunOptions
from jaxsfm.sfm.georeference.georeference import MeasuredPositions


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunInputs:
    """What a run is given besides the pixels of its photos."""

    selection: PairSelection
    pairs: list[Pair]
    """Those that are known before the photos are looked at."""
    cameras: Cameras
    measured: MeasuredPositions | None
    external: ExternalMatches
    weights: Weights
    relocalizer: Relocalizer | None


def read_inputs(
    photos: Sequence[ImageFile],
    plan: PanoramaPlan | None,
    skipped: Collection[str],
    rigs: Sequence[Rig],
    config: Config,
    options: RunOptions,
) -> RunInputs:
    """Read and check what the options of a run name.

    Args:
      photos: the usable photos.
      plan: of the panoramas among them. Files may name a panorama or its views.
      skipped: names of other photos, which files may name too.

    Raises:
      UserError: a file or an option cannot be used.
    """
    images, views = photos, list[ImageFile]()
    if plan is not None:
        images, views, rigs = plan.images, plan.views, (*rigs, plan.rig)
    names = [image.name for image in images]
    selection = parse_pair_selection(options.pairs)
    known = [*names, *(photo.name for photo in photos), *skipped]
    pairs = selected_pairs(selection, names, known)
    cameras = cameras_of(images, rigs, options)
    measured = measured_positions(options.georeference, photos, views)
    if plan is not None:
        pairs, measured = plan.pairs(pairs), measured and plan.measured(measured)
    external = read_external_matches(
        options.with_database, options.with_hloc, images, cameras.known, dense=options.with_dense
    )
    weights = chosen_weights(options.network, config.backbone)
    if selection.retrieval:
        check_retrieval(options.retrieval, weights)
    return RunInputs(
        selection=selection,
        pairs=pairs,
        cameras=cameras,
        measured=measured,
        external=external,
        weights=weights,
        relocalizer=weights.chosen_relocalizer(config),
    )


def cameras_of(images: Sequence[ImageFile], rigs: Sequence[Rig], options: RunOptions) -> Cameras:
    """What is known of the cameras of photos. UserError if it does not fit the photos."""
    check_prefixes(rigs, "--rig")
    mounted, known = rig_intrinsics(rigs, images), None
    if options.intrinsics is not None:
        known = used_cameras(parse_cameras(options.intrinsics), images)
    elif len(mounted) == len(images):
        known = mounted
    cameras = Cameras(
        known=known, sharing=options.cameras, model=options.camera_model, rigs=tuple(rigs)
    )
    cameras.check_fits(images)
    return cameras
