"""The structure that further views are registered on, and where they show its points: by their
matches, and found by alignment.

Neither its points nor its views move, however many poses of further views are tried.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.model import Model
from jaxsfm.colmap.tracks import Observations
from jaxsfm.colmap.view import View
from jaxsfm.config import Refinement
from jaxsfm.io.pairs import Pair, PairResult
from jaxsfm.sfm.refine import plane_geometry
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import align_blocks

REACH_PX = 16.0
"""A match lies on the surface of an observation this near, working pixels: two fine cells."""
MATCH_ERROR_PX = 12.0
"""Largest error of a right match, working pixels: COLMAP's limit for resection. The keypoints of a
dark image are about 4 px off, and cells are 8 px wide."""
MAX_SIGMA_PX = 1.0
"""Largest standard deviation of an observation, pixels of its octave. It may be larger than in the
refinement, because hundreds of observations determine one pose."""


class ResectionMatches(NamedTuple):
    """What says where views may stand: poses are found from it by resection."""

    matches: Mapping[Pair, PairResult]
    """Verified matches by pair, original pixels."""
    seed: int
    """For RANSAC in the resection."""


NO_MATCHES = ResectionMatches({}, 0)


def matched_points(
    image: View, structure: Model, normal: np.ndarray, matches: Mapping[Pair, PairResult]
) -> tuple[np.ndarray, np.ndarray]:
    """Matched keypoints of an image, and the surface under the keypoints that they match.

    Args:
      image: its pose plays no part.
      normal: (points, 3), of the structure's points.
      matches: original pixels. Pairs of other images are ignored.

    Returns:
      float64 (n, 2), working pixels of the image; float64 (n, 3), world points.
    """
    xy, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
    number = {view.name: k for k, view in enumerate(structure.views)}
    own = [pair for pair in matches if image.name in pair]
    others = [(number.get(b if a == image.name else a), (a, b)) for a, b in own]
    for k, pair in sorted((k, pair) for k, pair in others if k is not None):
        view, result = structure.views[k], matches[pair]
        sides = (result.keypoints0, result.keypoints1)
        mine, theirs = sides if pair[0] == image.name else sides[::-1]
        at, near = plane_geometry.under_pixels(
            structure, normal, k, view.pixels.from_original(theirs), reach_px=REACH_PX
        )
        xy.append(image.pixels.from_original(mine[near]))
        points.append(at)
    return np.concatenate(xy), np.concatenate(points)


class AlignedPoints(NamedTuple):
    """Points that one view shows, found by alignment."""

    rows: np.ndarray
    """int (n,): which points of the structure."""
    points: np.ndarray
    """float64 (n, 3), world units."""
    xy: np.ndarray
    """float64 (n, 2), where the view shows them, pixels of the octave."""
    candidates: np.ndarray
    """float64 (m, 3): all points that the view could show."""

    @classmethod
    def joined(cls, parts: Sequence["AlignedPoints"]) -> "AlignedPoints":
        """The points of several blocks, of which there may be none."""
        nothing = cls(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 3)))
        return cls(*(np.concatenate(column) for column in zip(nothing, *parts, strict=True)))

    def observations(self, view: int, rows: np.ndarray) -> Observations:
        """These points as observations of a model.

        Args:
          view: index of the view in the model.
          rows: int, for each point of the structure its index in the model.
        """
        return Observations(rows[self.rows], np.full(len(self.rows), view), self.xy)


@dataclasses.dataclass(frozen=True, eq=False)
class FixedStructure:
    """Points that some views see, with the images and the settings that align further views."""

    model: Model
    """The views, and the points with their observations."""
    images: DeviceImages
    """Those of the views and of the further ones, in working pixels."""
    refinement: Refinement
    known_normals: np.ndarray | None = None
    """float64 (points, 3): unit normals, if they do not follow from these observations."""

    @functools.cached_property
    def normals(self) -> np.ndarray:
        """float64 (points, 3): unit normals.

        They are the same in all octaves and with all further views. Of 9566 points they take 0.12
        s, and a pose is aligned up to 32 times, or more often if it is searched around. There must
        be a point.
        """
        if self.known_normals is not None:
            return self.known_normals
        return plane_geometry.normals(self.model, neighbours=self.refinement.neighbours)

    def some(self, rows: np.ndarray) -> "FixedStructure":
        """Some of the points, by their indices; their normals stay."""
        tracks = self.model.tracks.select_points(rows)
        return dataclasses.replace(
            self, model=self.model.with_tracks(tracks), known_normals=self.normals[rows]
        )

    def shown_from(self, views: Sequence[View], px: int) -> list[tuple[View, AlignedPoints]]:
        """For each of several further views, the view in pixels of an octave, and what it shows.

        Args:
          views: in working pixels.
          px: working pixels per pixel of the octave.
        """
        model = self.model.with_views([*self.model.views, *views]).in_octave(px)
        targets = range(len(self.model.views), len(model.views))
        limits = AlignmentLimits(
            self.refinement.weak_min_score, MAX_SIGMA_PX, self.refinement.max_shift_px
        )
        blocks = align_blocks(
            model,
            self.images.octave(px),
            self.refinement.in_all_views(),
            limits,
            targets=targets,
            normal=self.normals,
        )
        parts: list[list[AlignedPoints]] = [[] for _ in targets]
        for block in blocks:
            found, points = block.found, block.patches.points
            for k, part in zip(targets, parts, strict=True):
                own = found.view == k
                good = np.flatnonzero(own & block.agrees)
                at = found.point[good]
                shown = points[found.point[own]]
                part.append(AlignedPoints(block.rows[at], points[at], block.moved[good], shown))
        return [
            (model.views[k], AlignedPoints.joined(part))
            for k, part in zip(targets, parts, strict=True)
        ]
