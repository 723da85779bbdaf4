"""Views in which refinement finds nothing to align, because photon noise hides it, and images that
the mapper left out: a night among days. They are placed on the structure that the other views make,
at octaves where noise averages out (`jaxsfm.sfm.refine.octave_pose`).

What agrees there is evidence of its own: a dozen right matches among many wrong ones are enough to
start from.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxsfm.colmap.model import Sizes, Tracks, View, build_model, part_of, read_model_arrays
from jaxsfm.colmap.resection import find_view
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.octave_pose import MIN_COUNT, Pose, PoseHypothesis, follow, trusted

if TYPE_CHECKING:
    import pycolmap


REACH_PX = 16.0
"""A match lies on the surface of an observation this near, working pixels: two fine cells."""
MATCH_ERROR_PX = 12.0
"""Of right matches, working pixels: COLMAP's limit for resection. A dark image's keypoints lie 4 px
off, and cells are 8 px wide."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placement:
    """What became of a weak view, or of an image that was not in the model."""

    name: str
    registered: bool
    """It was in the model before."""
    octave_px: int | None
    """Working pixels per pixel of the octave that gives the pose; None: too little agrees, nothing
    changes."""
    candidates: int
    """Points of the other views that it could see."""
    agreed: int
    """Those that agree, at that octave (None: at the last)."""
    error_px: float | None
    """Median distance of where they agree from where the pose puts them, working pixels."""
    held: int | None = None
    """Taken out of the model, for so few observations held it there; None: it was not."""


class UnmappedImage(NamedTuple):
    """An image that is in no model."""

    name: str
    image_id: int
    camera: "pycolmap.Camera"


class Evidence(NamedTuple):
    """What there is beside a model."""

    matches: Mapping[Pair, PairResult]
    """Verified matches by pair, original pixels."""
    left_out: Sequence[UnmappedImage]
    seed: int
    """Of the resection from matches."""


NO_EVIDENCE = Evidence({}, (), 0)


def _structure(tracks: Tracks, weak: Sequence[int]) -> tuple[Tracks, np.ndarray]:
    """The points that at least two of the other views see, those observations, and which points
    they are."""
    strong = ~np.isin(tracks.view, weak)
    count = np.bincount(tracks.point[strong], minlength=len(tracks.points))
    rows = np.flatnonzero(count >= 2)
    place = np.full(len(tracks.points), -1)
    place[rows] = np.arange(len(rows))
    keep = np.flatnonzero(strong & (place[tracks.point] >= 0))
    return (
        Tracks(tracks.points[rows], place[tracks.point[keep]], tracks.view[keep], tracks.xy[keep]),
        rows,
    )


def matched_points(
    image: View,
    views: list[View],
    structure: Tracks,
    normal: np.ndarray,
    matches: Mapping[Pair, PairResult],
) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (n, 2) of an image, working pixels, and the surface (n, 3) under their partners.

    Args:
      image: its pose does not count.
      normal: of the structure's points.
    """
    xy, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
    for k, view in enumerate(views):
        pair = make_pair(image.name, view.name)
        if pair not in matches:
            continue
        result = matches[pair]
        sides = (result.keypoints0, result.keypoints1)
        mine, theirs = sides if pair[0] == image.name else sides[::-1]
        at, near = plane_geometry.under_pixels(
            structure, views, normal, k, (theirs + 0.5) / view.scale - 0.5, reach_px=REACH_PX
        )
        xy.append((mine[near] + 0.5) / image.scale - 0.5)
        points.append(at)
    return np.concatenate(xy), np.concatenate(points)


def _outside(left_out: Sequence[UnmappedImage], sizes: Sizes) -> list[View]:
    """Views of images without a pose."""
    return [
        View(
            image_id=image_id,
            name=name,
            rotation=np.eye(3),
            centre=np.zeros(3),
            camera=camera,
            scale=np.asarray(sizes[name][1], np.float64),
            size=sizes[name][0],
        )
        for name, image_id, camera in left_out
    ]


def place_weak_views(
    model: "pycolmap.Reconstruction",
    weak: Sequence[str],
    read: Reader,
    sizes: Sizes,
    *,
    config: Refinement,
    refine_intrinsics: bool,
    evidence: Evidence,
) -> "tuple[pycolmap.Reconstruction, list[Placement]]":
    """The model with its weak views, and images left out, placed on the structure of the other
    views, which stays as it is.

    A placed view gets the observations that agree with its new pose instead of those it had. A
    weak view starts from its pose and from its matches, an image left out from its matches.

    Args:
      model: not changed.
      weak: names of registered images.
      read, sizes: as in `refine_model`; sizes of the images left out too.
      refine_intrinsics: whether a placed view's focal length moves too, if the camera is its own.
    """
    views, tracks = read_model_arrays(model, sizes)
    images = [*views, *_outside(evidence.left_out, sizes)]
    weak_ones = [k for k, view in enumerate(views) if view.name in weak]
    wanted = [*weak_ones, *range(len(views), len(images))]
    structure, rows = _structure(tracks, weak_ones)
    poses: dict[int, list[PoseHypothesis]] = {k: [] for k in wanted}
    if len(rows) and config.weak_octaves:
        poses = _starts(images, views, structure, wanted, evidence, config, refine_intrinsics)
        follow([pose for mine in poses.values() for pose in mine], views, structure, read, config)
    figures, best = [], {}
    for k, mine in poses.items():
        right = [pose for pose in map(trusted, mine) if pose is not None]
        if right:
            best[k] = min(right, key=lambda pose: pose.doubt_px)
        figures.append(_figures(images[k].name, k < len(views), mine, best.get(k)))
    if not best:
        return model, figures
    return build_model(model, *_joined(views, tracks, best, rows)), figures


def take_out(
    model: "pycolmap.Reconstruction", placed: Sequence[Placement], sizes: Sizes
) -> "tuple[pycolmap.Reconstruction, list[Placement]]":
    """The model without the views that nothing holds: alignment does not confirm their poses, and
    they have fewer observations than COLMAP asks for to register an image (`MIN_COUNT` too).

    They are photos of another place: what looks alike gives a pose, and bundle adjustment drops one
    observation after the other. Of 186 models of runs two had such a view, with 0 and with 4
    observations, where others had thousands; no other photograph had fewer than 60.

    Args:
      placed: what became of the weak views.
      sizes: as in `refine_model`.
    """
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    held = {image.name: image.num_points3D for image in images}
    refuted = {
        each.name
        for each in placed
        if each.registered and each.octave_px is None and held[each.name] < MIN_COUNT
    }
    stay = held.keys() - refuted
    if not refuted or len(stay) < 2:
        return model, list(placed)
    others, theirs, _ = part_of(*read_model_arrays(model, sizes), stay)
    return build_model(model, others, theirs), [
        dataclasses.replace(each, held=held[each.name]) if each.name in refuted else each
        for each in placed
    ]


def _starts(
    images: list[View],
    views: list[View],
    structure: Tracks,
    wanted: Sequence[int],
    evidence: Evidence,
    config: Refinement,
    refine_intrinsics: bool,
) -> dict[int, list[PoseHypothesis]]:
    """The poses to follow, per wanted image."""
    normal = plane_geometry.normals(structure, views, neighbours=config.neighbours)
    cameras = [view.camera.camera_id for view in images]
    starts = {}
    for k in wanted:
        own = refine_intrinsics and cameras.count(cameras[k]) == 1
        found = find_view(
            images[k],
            *matched_points(images[k], views, structure, normal, evidence.matches),
            max_error_px=MATCH_ERROR_PX,
            estimate_focal_length=own and not images[k].camera.has_prior_focal_length,
            seed=evidence.seed,
        )
        starts[k] = [
            PoseHypothesis(view=view, own_camera=own)
            for view in ([views[k]] if k < len(views) else []) + ([found] if found else [])
        ]
    return starts


def _figures(
    name: str, registered: bool, mine: list[PoseHypothesis], best: Pose | None
) -> Placement:
    most = max(mine, key=lambda pose: pose.agreed, default=None)
    return Placement(
        name=name,
        registered=registered,
        octave_px=best.octave_px if best else None,
        candidates=len(best.observed.could) if best else most.candidates if most else 0,
        agreed=best.agreed if best else most.agreed if most else 0,
        error_px=best.error_px if best else None,
    )


def _joined(
    views: list[View], tracks: Tracks, best: Mapping[int, Pose], rows: np.ndarray
) -> tuple[list[View], Tracks]:
    """Views and tracks with the placed ones, whose old observations go.

    Args:
      best: by index; past the last view: an image left out.
      rows: which points the structure's are.
    """
    stay = ~np.isin(tracks.view, list(best))
    parts = [(tracks.point[stay], tracks.view[stay], tracks.xy[stay])]
    every = list(views)
    for k, pose in sorted(best.items()):
        at = min(k, len(every))
        every[at : at + 1] = [pose.view]
        seen = pose.observed
        parts.append((rows[seen.rows], np.full(len(seen.rows), at), seen.xy))
    point, view, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((view, point))
    return every, Tracks(tracks.points, point[order], view[order], xy[order])
