"""One model of the models of parts, whose frames are known.

The models come from one database, so a keypoint is at exactly the same place in all of them. Points
of several models that share a keypoint are one point.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Observations, Tracks
from jaxsfm.colmap.view import View
from jaxsfm.sfm.evaluation import Similarity


def merged(models: Sequence[Model], frames: Mapping[int, Similarity]) -> Model:
    """The photos and points of several models as one model.

    A photo has its pose in the model where it has most observations. A point lies in the middle of
    the points that are one. Points stay apart where, as one, they would have two keypoints in one
    photo.

    Args:
      models: the one whose cameras count first.
      frames: for some of them, by number, the similarity to the frame of the result.
    """
    chosen = sorted(frames)
    views = _views(models, frames)
    place = {view.name: k for k, view in enumerate(views)}
    points, rows = [np.zeros((0, 3))], []
    for number in chosen:
        model = models[number]
        own = np.asarray([place[view.name] for view in model.views], np.int64)
        first = sum(map(len, points))
        points.append(frames[number].moved_points(model.tracks.points))
        tracks = model.tracks
        rows.append(Observations(tracks.point + first, own[tracks.view], tracks.xy))
    tracks = _joined_tracks(Tracks.from_parts(np.concatenate(points), rows))
    cameras = {
        i: camera for number in reversed(chosen) for i, camera in models[number].cameras.items()
    }
    return Model(views, tracks, cameras)


def _views(models: Sequence[Model], frames: Mapping[int, Similarity]) -> list[View]:
    """The photos in the frame of the result, in the order of their ids."""
    chosen = {number: models[number] for number in sorted(frames)}
    cameras = {}
    for model in chosen.values():
        for view in model.views:
            cameras.setdefault(view.camera.camera_id, view.camera)
    found = []
    for number, view in homes(chosen).values():
        moved = view.at(frames[number].moved(view.pose))
        found.append(dataclasses.replace(moved, camera=cameras[view.camera.camera_id]))
    return sorted(found, key=lambda view: view.image_id)


def homes(models: Mapping[int, Model]) -> dict[str, tuple[int, View]]:
    """For each photo, the number of the model in which it has most observations, the first of equal
    ones, and its view there."""
    most: dict[str, int] = {}
    found: dict[str, tuple[int, View]] = {}
    for number, model in models.items():
        seen = np.bincount(model.tracks.view, minlength=len(model.views))
        for view, count in zip(model.views, seen.tolist(), strict=True):
            if count > most.get(view.name, -1):
                most[view.name], found[view.name] = count, (number, view)
    return found


def _joined_tracks(tracks: Tracks) -> Tracks:
    """Tracks whose points that share a keypoint are one, each keypoint once."""
    keypoints, which = np.unique(
        np.c_[tracks.view, tracks.xy], axis=0, return_inverse=True, return_index=False
    )
    which = which.ravel()
    count = len(tracks.points)
    size = count + len(keypoints)
    edges = coo_array((np.ones(len(which)), (tracks.point, count + which)), shape=(size, size))
    label = connected_components(edges, directed=False)[1]
    view = keypoints[:, 0].astype(np.int64)
    # A component that has two keypoints in one photo is left in its parts.
    pairs, times = np.unique(np.c_[label[count:], view], axis=0, return_counts=True)
    torn = np.zeros(label.max(initial=-1) + 1, bool)
    torn[pairs[times > 1, 0]] = True
    apart = torn[label[:count]]
    label[:count][apart] = len(torn) + np.flatnonzero(apart)
    _, target = np.unique(label[:count], return_inverse=True)
    target = target.ravel()
    number = np.bincount(target)
    points = np.stack([np.bincount(target, axis) / number for axis in tracks.points.T], axis=1)
    # Each keypoint belongs to one point: of points that stayed apart, to the first one.
    order = np.lexsort((target[tracks.point], which))
    first = order[np.unique(which[order], return_index=True)[1]]
    first = first[np.lexsort((tracks.view[first], target[tracks.point[first]]))]
    return Tracks(points, target[tracks.point[first]], tracks.view[first], tracks.xy[first])
