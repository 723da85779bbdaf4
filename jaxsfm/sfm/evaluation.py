"""How far the cameras of a model are from reference poses, after the best similarity.

The similarity (Sim3) is found from the camera centres of all common images, or of some of them: the
paper's night protocol aligns on day cameras and scores the night camera (section 4.1).
"""

import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsfm.colmap.poses import CameraPose, Poses
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json
from jaxsfm.io.pairs import listed_lines
from jaxsfm.sfm.view_graph import mean_rotation, rotation_angle_deg

DISTANCES = (0.5, 1.0, 5.0, 10.0, 20.0)
"""Distances at which the share of good images is counted, units of the reference."""
MAX_ROTATION_DEG = 10.0
"""A good image's rotation is off by no more."""
COLLINEAR = 1e-4
"""Centres are on one line if their second singular value is less than this share of the first. The
roll about the line is then unknown."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseError:
    """How far the pose of one image is from its reference."""

    position: float
    """Units of the reference."""
    rotation_deg: float


def pose_error(pose: CameraPose, truth: CameraPose) -> PoseError:
    """How far a pose is from its reference, in the same frame."""
    return PoseError(
        position=float(np.linalg.norm(pose.centre - truth.centre)),
        rotation_deg=float(rotation_angle_deg(pose.rotation, truth.rotation)),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Errors of the registered images that have a reference pose."""

    images: dict[str, PoseError]
    missing: list[str]
    """Reference images without a pose in the model. They count as failures in `within`."""
    aligned_on: int
    """Number of images whose centres determined the similarity."""

    def _stats(self, field: str) -> dict[str, float]:
        values = [getattr(error, field) for error in self.images.values()]
        return {
            "mean": float(np.mean(values)),
            "median": float(np.median(values)),
            "max": float(np.max(values)),
        }

    @property
    def position(self) -> dict[str, float]:
        """Mean, median and max, units of the reference."""
        return self._stats("position")

    @property
    def rotation_deg(self) -> dict[str, float]:
        """Mean, median and max, degrees."""
        return self._stats("rotation_deg")

    @property
    def within(self) -> dict[float, float]:
        """By distance: the share of the reference's images within it and within 10 degrees."""
        total = len(self.images) + len(self.missing)
        return {
            d: sum(
                e.position <= d and e.rotation_deg <= MAX_ROTATION_DEG for e in self.images.values()
            )
            / total
            for d in DISTANCES
        }

    def as_dict(self) -> dict[str, Json]:
        """The evaluation as plain JSON (`jaxsfm.report.run_results.EvaluationReport`)."""
        return {
            "registered": len(self.images),
            "reference_images": len(self.images) + len(self.missing),
            "aligned_on": self.aligned_on,
            "position": self.position,
            "rotation_deg": self.rotation_deg,
            "within_10deg": {f"{d:g}": share for d, share in self.within.items()},
            "images": {n: dataclasses.asdict(e) for n, e in sorted(self.images.items())},
            "missing": self.missing,
        }


def pair_names(ours: Collection[str], reference: Collection[str]) -> dict[str, str]:
    """Our name -> the reference's name, of the images that both have.

    Names are paired if they are equal, or if their stems are equal and unique (0000.jpg, 0000.png).
    """
    pairs = {name: name for name in ours if name in reference}
    stems: dict[str, list[str]] = {}
    for name in reference:
        stems.setdefault(Path(name).stem, []).append(name)
    taken = set(pairs.values())
    own_stems = [Path(name).stem for name in ours]
    for name in ours:
        stem = Path(name).stem
        other = stems.get(stem, [])
        if name not in pairs and len(other) == 1 and other[0] not in taken:
            if own_stems.count(stem) == 1:
                pairs[name] = other[0]
    return pairs


def of_photos(reference: Poses, photos: Collection[str]) -> Poses:
    """The reference poses of some photos. A reference may have many more than a run was given."""
    return {name: reference[name] for name in pair_names(photos, reference).values()}


def read_names(path: Path) -> list[str]:
    """The image names in a text file, one on each line; UserError if there are none."""
    names = [line for _, line in listed_lines(path, "--align-on")]
    if not names:
        raise UserError(f"--align-on {path}: no names in it")
    return names


class Similarity(NamedTuple):
    """The map x -> scale * rotation @ x + translation."""

    scale: float
    rotation: np.ndarray
    """float64 (3, 3)."""
    translation: np.ndarray
    """float64 (3,)."""

    def moved(self, pose: CameraPose) -> CameraPose:
        """The pose after the map was applied to the world."""
        centre = self.scale * self.rotation @ pose.centre + self.translation
        return CameraPose(pose.rotation @ self.rotation.T, centre)

    def moved_points(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) after the map."""
        return self.scale * points @ self.rotation.T + self.translation


def umeyama(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None
) -> Similarity:
    """The similarity that takes `source` to `target` with the least squared error.

    It is computed here because `estimate_sim3d` of pycolmap 4.2 gives nothing for points on a plane
    (measured: none of 200 random sets), and cameras carried at one height are such points.

    Source: Umeyama 1991, equations 40-43.

    Args:
      source, target: float64 (n, 3), not on one line.
      weights: float64 (n,), of the squared errors; default: all 1.
    """
    share = np.ones(len(source)) if weights is None else weights
    share = (share / share.sum())[:, None]
    mean0, mean1 = (share * source).sum(0), (share * target).sum(0)
    a, b = source - mean0, target - mean1
    u, d, vt = np.linalg.svd((share * b).T @ a)
    sign = np.ones(3)
    sign[2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (share * a**2).sum())
    return Similarity(scale, rotation, mean1 - scale * rotation @ mean0)


def align(ours: np.ndarray, reference: np.ndarray) -> Similarity:
    """The similarity that takes our centres (n, 3) to the reference's.

    Raises:
      UserError: fewer than three centres, or (nearly) on one line in either set.
    """
    if len(ours) < 3:
        raise UserError(
            f"--reference: {len(ours)} common images with a pose; at least 3 are needed to align"
        )
    for centres, whose in ((reference, "the reference's"), (ours, "the model's")):
        spread = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
        if spread[0] == 0 or spread[1] < COLLINEAR * spread[0]:
            raise UserError(
                f"--reference: {whose} camera centres lie on one line (or in one place), "
                "which leaves the alignment undetermined"
            )
    return umeyama(ours, reference)


def common_alignment(
    model: Poses, reference: Poses, *, align_on: Collection[str] | None = None
) -> tuple[dict[str, str], list[str], Similarity]:
    """Align a model to reference poses. Arguments and errors are those of `evaluate`.

    Returns:
      our name -> the reference's name, of the common images; our names of those aligned on; the
      similarity that takes the model to the reference.
    """
    names = pair_names(model, reference)
    if not names:
        raise UserError(
            f"--reference: no common images (the model has e.g. {min(model, default='none')!r}, "
            f"the reference {min(reference, default='none')!r})"
        )
    chosen = sorted(names)
    if align_on is not None:
        known = set(names) | set(model) | set(reference)
        if unknown := [name for name in align_on if name not in known]:
            raise UserError(f"--align-on: no image named {unknown[0]!r}")
        wanted = set(align_on)
        chosen = [n for n in chosen if n in wanted or names[n] in wanted]
    similarity = align(
        np.asarray([model[n].centre for n in chosen]).reshape(-1, 3),
        np.asarray([reference[names[n]].centre for n in chosen]).reshape(-1, 3),
    )
    return names, chosen, similarity


def evaluate(
    model: Poses, reference: Poses, *, align_on: Collection[str] | None = None
) -> Evaluation:
    """Compare the poses of a model with reference poses.

    Args:
      model: poses by image name (`jaxsfm.model_poses`).
      reference: poses by image name (`jaxsfm.read_poses`).
      align_on: names (the model's or the reference's) of the images whose centres determine the
        similarity. By default these are all common images.

    Raises:
      UserError: no common images, unknown names, or centres that determine no similarity.
    """
    names, chosen, sim = common_alignment(model, reference, align_on=align_on)
    errors = {}
    for name, other in sorted(names.items()):
        errors[name] = pose_error(sim.moved(model[name]), reference[other])
    missing = sorted(set(reference) - set(names.values()))
    return Evaluation(images=errors, missing=missing, aligned_on=len(chosen))


def own_rotation_deg(model: Poses, reference: Poses) -> float:
    """The mean rotation error, degrees, after the rotations alone have been aligned.

    `evaluate` aligns camera centres. If these are nearly on a line, small position errors turn all
    cameras about this line, and most of its rotation errors are this common turn. Here the common
    turn is that of the rotations themselves (their chordal mean), so it does not count.

    Raises:
      UserError: no common images.
    """
    names = pair_names(model, reference)
    if not names:
        raise UserError("--reference: no common images")
    ours = np.asarray([model[name].rotation for name in names])
    theirs = np.asarray([reference[other].rotation for other in names.values()])
    turns = theirs.transpose(0, 2, 1) @ ours
    common = mean_rotation(turns, np.ones(len(turns)))
    return float(rotation_angle_deg(turns, common).mean())
