"""Models moved onto measured positions of their photos, or onto ground control points."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from jaxsfm.colmap.poses import model_poses
from jaxsfm.colmap.reconstruction import move_model, registered, usual_distance
from jaxsfm.colmap.rigs import one_of_each_frame
from jaxsfm.colmap.turned_cameras import shares_one_camera
from jaxsfm.colmap.view import View
from jaxsfm.io.orientation import UPRIGHT
from jaxsfm.io.photos import Pixels
from jaxsfm.io.position_tables import ControlPoint, Position
from jaxsfm.sfm.evaluation import Similarity
from jaxsfm.sfm.georeference.coordinate_system import CoordinateSystem, Frame
from jaxsfm.sfm.georeference.inside import Settings, positions_inside
from jaxsfm.sfm.georeference.model_georeference import (
    ModelGeoreference,
    NamedAnchors,
    contradicted,
    georeferenced,
)
from jaxsfm.sfm.georeference.readings import Fit, is_upside_down, misread
from jaxsfm.sfm.georeference.robust_similarity import Anchors

if TYPE_CHECKING:
    import pycolmap

Source = Literal["gps", "positions", "control points"]
_WORDS = {
    "gps": "photos with a GPS position and height",
    "positions": "photos with a position and height",
    "control points": "control points that two photos show",
}
CLICK_PX = 2.0
"""Errors of measurements well beyond this many pixels lose their weight (soft L1)."""
NEAREST, FARTHEST = 1e-3, 1e5
"""Half of what photos show is not nearer and not farther, metres: lenses that see more than a
millimetre at once do not focus nearer, and the air hides what is 100 km away."""
PARALLEL = 1e-6
"""Rays with a smaller squared sine between them leave the depth of a point unknown."""
BEHIND_PX = 1e6
"""Stands for the error of a point that lies behind a camera, which has no image of it."""


class TriangulatedPoint(NamedTuple):
    """A control point in the frame of a model."""

    xyz: np.ndarray
    """float64 (3,)."""
    errors_px: dict[str, float]
    """By the name of the photo: from the measurement to where the model projects the point,
    original pixels."""


def views_by_name(model: "pycolmap.Reconstruction") -> dict[str, View]:
    """The views of a model's registered images, in original pixels."""
    views = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        camera = model.camera(image.camera_id)
        views[image.name] = View(
            image_id=image_id,
            name=image.name,
            rotation=image.cam_from_world().rotation.matrix(),
            centre=np.asarray(image.projection_center()),
            camera=camera,
            pixels=Pixels((1.0, 1.0)),
            size=(camera.width, camera.height),
        )
    return views


def triangulated(
    views: Mapping[str, View], seen: Mapping[str, tuple[float, float]]
) -> TriangulatedPoint | None:
    """The point that photos show at the given pixels.

    The sum of squared reprojection errors is minimised, from the point that is nearest to all rays.
    A measurement that is far off counts less.

    Args:
      views: of the model, by name.
      seen: (x, y) in original pixels, by the name of the photo; photos without a view are ignored.

    Returns:
      None if fewer than two views show the point, or their rays are parallel.
    """
    shown = [(views[name], np.asarray([xy])) for name, xy in sorted(seen.items()) if name in views]
    if len(shown) < 2:
        return None
    rays = np.concatenate([view.rays(xy) for view, xy in shown])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    centres = np.asarray([view.centre for view, _ in shown])
    normal = across.sum(0)
    if not np.linalg.eigvalsh(normal)[0] > PARALLEL:
        return None
    start = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centres))
    depth = np.median(np.linalg.norm(centres - start, axis=1))

    def errors(moved: np.ndarray) -> np.ndarray:
        point = start + depth * moved  # scaled, so that the units of the model do not matter
        found = [view.project(point[None])[0] - xy for view, xy in shown]
        return np.nan_to_num(np.concatenate(found), nan=BEHIND_PX).ravel()

    solved = least_squares(errors, np.zeros(3), loss="soft_l1", f_scale=CLICK_PX, xtol=1e-12)
    lengths = np.linalg.norm(errors(solved.x).reshape(-1, 2), axis=1)
    by_name = {view.name: float(px) for (view, _), px in zip(shown, lengths, strict=True)}
    return TriangulatedPoint(start + depth * solved.x, by_name)


@dataclass(frozen=True, kw_only=True)
class MeasuredPositions:
    """What models are moved onto."""

    source: Source
    file: str | None
    """The file that they were read from; None for the GPS positions of photos."""
    system: CoordinateSystem
    positions: Mapping[str, Position]
    """Positions of cameras, by the name of the photo. With control points they play no part."""
    points: list[ControlPoint] = field(default_factory=list)
    """Control points, whose measurements name photos of the run."""
    sure: bool
    """Whether a model is left as it is if its move would not be certain."""

    def frame(self) -> Frame | None:
        """The frame of the moved models; None if no position has a height."""
        given = [point.position for point in self.points] or self.positions.values()
        full = [(at.x, at.y, at.z) for at in given if at.z is not None]
        return self.system.frame(np.asarray(full, np.float64)) if full else None

    def local(self, frame: Frame | None) -> dict[str, Position]:
        """The positions of cameras that have a height, in a frame."""
        known = [] if frame is None else self.positions.items()
        return {name: self._moved(at, frame) for name, at in known if frame and at.full}

    def _moved(self, at: Position, frame: Frame) -> Position:
        x, y, z = self.system.into(frame, np.asarray([[at.x, at.y, at.z]], np.float64))[0].tolist()
        return Position(x, y, z, at.deviation)

    def raw(self, names: list[str]) -> np.ndarray:
        """float64 (n, 3): the positions of photos or of control points in the file's own numbers.
        All of them have a height."""
        points = {point.name: point.position for point in self.points}
        given = points or self.positions
        return np.asarray([given[name][:3] for name in names], np.float64).reshape(-1, 3)

    def anchors(self, model: "pycolmap.Reconstruction", frame: Frame | None) -> NamedAnchors:
        """What a model, in the frame of the mapper, has of the measured positions."""
        if self.points and frame is not None:
            return self._points_in(model, frame)
        return self._photos_in(model, frame)

    def _photos_in(self, model: "pycolmap.Reconstruction", frame: Frame | None) -> NamedAnchors:
        poses = model_poses(model)
        known = self.local(frame)
        # Photos of one frame have one position, which counts once.
        names = one_of_each_frame(sorted(poses.keys() & known.keys()), model)
        flat = sorted(poses.keys() & self.positions.keys() - known.keys())
        deviations = [known[name].deviation for name in names]
        usual = np.median([each for each in deviations if each is not None] or [1.0])
        return NamedAnchors(
            names,
            Anchors(
                np.asarray([poses[name].centre for name in names]).reshape(-1, 3),
                np.asarray([known[name][:3] for name in names]).reshape(-1, 3),
                np.asarray([float(usual if each is None else each) for each in deviations]),
            ),
            deviations,
            [{} for _ in names],
            {name: "its position has no height" for name in flat},
        )

    def _points_in(self, model: "pycolmap.Reconstruction", frame: Frame) -> NamedAnchors:
        views, names, found, unused = views_by_name(model), [], [], {}
        targets = []
        for point in sorted(self.points, key=lambda point: point.name):
            seen = {each.image: (each.x, each.y) for each in point.seen}
            in_model = triangulated(views, seen)
            if in_model is None:
                shown = len(seen.keys() & views.keys())
                unused[point.name] = (
                    f"{shown} photos of the model show it; at least 2 are needed"
                    if shown < 2
                    else "the photos see it along one line"
                )
                continue
            names.append(point.name)
            found.append(in_model)
            targets.append(self._moved(point.position, frame)[:3])
        source = np.asarray([each.xyz for each in found]).reshape(-1, 3)
        target = np.asarray(targets, np.float64).reshape(-1, 3)
        anchors = Anchors(source, target, np.ones(len(names)))
        errors = [each.errors_px for each in found]
        return NamedAnchors(names, anchors, [None] * len(names), errors, unused)


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """How the models of a run were moved into metres."""

    source: Source
    file: str | None = None
    frame: Frame | None
    """None if no position has a height."""
    models: list[ModelGeoreference]
    """One for each model."""


def move_models(
    models: "list[pycolmap.Reconstruction]",
    measured: MeasuredPositions,
    turned: Mapping[str, int] | None = None,
    settings: Settings | None = None,
) -> Georeference:
    """Move models, each by itself, onto measured positions. The models change in place.

    A model stays where it is if the photos contradict the positions of a file.

    Args:
      turned: how photos are turned that are not stored upright, by name.
      settings: of an adjustment in which positions of cameras take part. None: there is none, and
        the models are moved as they are.
    """
    frame, placed = measured.frame(), []
    for model in models:
        given = measured.anchors(model, frame)
        figures, similarity = georeferenced(given, _WORDS[measured.source], sure=measured.sure)
        if similarity is not None and measured.file is not None:
            against = _contradiction(model, measured, given, similarity)
            if against is not None:
                figures, similarity = contradicted(figures, against), None
        if similarity is not None:
            rotations = {name: pose.rotation for name, pose in model_poses(model).items()}
            hang = measured.system.kind != "local" and is_upside_down(
                rotations, turned or {}, similarity
            )
            figures = replace(figures, upside_down=hang)
            move_model(model, *similarity)
            if settings is not None and not measured.points:
                figures = positions_inside(model, given, figures, _held(model, settings, turned))
        placed.append(figures)
    return Georeference(source=measured.source, file=measured.file, frame=frame, models=placed)


def _held(
    model: "pycolmap.Reconstruction", settings: Settings, turned: Mapping[str, int] | None
) -> Settings:
    """The settings for a model. Photos of one camera that were turned differently could not share
    it any more, so their cameras are held."""
    codes = dict.fromkeys(registered(model), UPRIGHT) | dict(turned or {})
    return settings._replace(
        refine_intrinsics=settings.refine_intrinsics and not shares_one_camera(model, codes)
    )


def _contradiction(
    model: "pycolmap.Reconstruction",
    measured: MeasuredPositions,
    given: NamedAnchors,
    similarity: Similarity,
) -> str | None:
    """Why the photos contradict the positions of a file, in words; None if they do not."""
    distance = similarity.scale * usual_distance(model)
    if distance < NEAREST or distance > FARTHEST:  # not so if the model has no points
        return (
            f"the photos would show what is {distance:.2g} m away, which no camera does; is the "
            "unit of the positions the one that the file says?"
        )
    fit = Fit(given.anchors, similarity)
    meant = misread(fit, measured.raw(given.names), measured.system)
    return meant and f"the {_WORDS[measured.source]} contradict the photos: {meant}"
