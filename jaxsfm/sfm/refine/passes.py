"""Multi-view refinement of keypoints, in passes after mapping.

In a pass, every observation of a track is moved onto one reference patch. Views into which the
point projects, and that agree with the patch, get new observations; observations that do not agree
are dropped. Bundle adjustment and filtering follow.

The reference keypoint stays where it is, because it defines the point. So the spread of relocalized
keypoints over the views (1-2 px) goes, and a track reaches every view that shows its surface. Views
that show too little to be aligned in this way are registered at the end, on the structure of the
others (`jaxsfm.sfm.refine.weak_views`).

A few hundred points for each view make the poses good, so all passes but the last one are done with
the points of the matches that the mapper was given. Then all others return.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from jaxsfm.colmap.mapper import MIN_MODEL_POINTS
from jaxsfm.colmap.model import Model, Sizes
from jaxsfm.colmap.other_camera import OtherCamera
from jaxsfm.colmap.rigs import mounted_photos
from jaxsfm.io.photos import Reader
from jaxsfm.sfm.refine.device_images import DeviceImages
from jaxsfm.sfm.refine.fixed_structure import NO_MATCHES, ResectionMatches
from jaxsfm.sfm.refine.one_pass import (
    PassFigures,
    PassSettings,
    Refined,
    run_pass,
)
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.weak_views import RegistrationAttempt, register_weak_views

if TYPE_CHECKING:
    import pycolmap


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefinementFigures:
    """The result of the refinement of a model."""

    passes: list[PassFigures]
    registrations: list[RegistrationAttempt]
    """One for each view that was weak in any pass, and for each photo without a place that was to
    be registered."""
    camera: OtherCamera | None = None
    """The camera that the photos speak for, if it is not the one that was held."""
    holds: bool = True
    """Whether confirmed points hold three views together or more
    (`jaxsfm.sfm.refined_models.covisibility_components`)."""

    @property
    def confirmed(self) -> bool:
        """Whether enough points were found in the photos: a pass was made, and was accepted, and
        what is left holds."""
        return self.holds and any(done.accepted for done in self.passes)

    def unconfirmed_views(self) -> set[str]:
        """The views that nothing confirms: the last pass has not aligned their observations, and
        no octave has given them a pose. What looks alike has given the mapper's poses to them."""
        weak = {name for done in _accepted(self.passes)[-1:] for name in done.weak_views}
        return {
            each.name for each in self.registrations if each.octave_px is None and each.name in weak
        }


def _as_arrays(reconstruction: "pycolmap.Reconstruction", sizes: Sizes) -> Refined:
    return Refined(reconstruction, Model.from_colmap(reconstruction, sizes))


def _sizes_of_passes(passes: int, described_px: int) -> list[int]:
    """The sizes of a pixel in all passes, working pixels."""
    larger = [2**k for k in reversed(range(described_px.bit_length() - 1))]
    return [described_px] * passes + larger


def working_sizes(reconstruction: "pycolmap.Reconstruction", read: Reader) -> Sizes:
    """The sizes of the working images of a model."""
    sizes = {}
    for image_id in sorted(reconstruction.reg_image_ids()):
        name = reconstruction.image(image_id).name
        gray, scale = read(name)
        sizes[name] = (gray.shape[1], gray.shape[0]), scale
    return sizes


def refine_model(
    reconstruction: "pycolmap.Reconstruction",
    read: Reader,
    settings: PassSettings,
    *,
    resection: ResectionMatches = NO_MATCHES,
    with_all_points: "Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction] | None" = None,
    described_px: int = 1,
    on_pass: Callable[[], None] = lambda: None,
) -> "tuple[pycolmap.Reconstruction, RefinementFigures]":
    """Refine a model.

    Thresholds are in pixels of the working images. An image where too little agrees keeps its old
    observations, with four times the error limit, until it is registered on the refined structure.
    Images that show far less of what they should show than others do may have a wrong pose of the
    mapper. They are registered in the same way. A pass that would lose most of the points is taken
    back.

    Args:
      reconstruction: from the mapper; not changed.
      read: intensities by image name; may be called several times per image.
      settings: of the passes. With one thread the model is repeatable to the last byte.
      resection: matches to place weak views by.
      with_all_points: gives a model the points of all matches, before the last of the `passes`.
        None: it has them already.
      described_px: the size of a pixel in which the keypoints were found, a power of two of working
        pixels. The `passes` are done with images of this size, and one more follows at each size
        above it, up to the working size: keypoints of a small image are too far off for a larger
        one.
      on_pass: called after every pass.

    Raises:
      ImageError: an image of the model cannot be read any more.
    """
    sizes = working_sizes(reconstruction, read)
    images, refinement = DeviceImages(read), settings.refinement
    now = _as_arrays(reconstruction, sizes)
    figures: list[PassFigures] = []
    limits = AlignmentLimits.of(refinement)
    for number, px in enumerate(_sizes_of_passes(refinement.passes, described_px)):
        if number > 0:
            limits = limits._replace(max_shift_px=refinement.max_shift_px / 2)
        if with_all_points is not None and number == refinement.passes - 1:
            now, with_all_points = _as_arrays(with_all_points(now.reconstruction), sizes), None
            limits = AlignmentLimits.of(refinement)  # the keypoints of new points are not aligned
        if len(now.model.tracks.points) < MIN_MODEL_POINTS or len(now.model.views) < 2:
            break
        now, done = run_pass(now, images, px, limits, settings)
        on_pass()
        figures.append(done)
        if not done.accepted:
            break
    if with_all_points is not None:  # the passes ended early
        now = _as_arrays(with_all_points(now.reconstruction), sizes)
    reconstruction, attempts = now.reconstruction, list[RegistrationAttempt]()
    mounted = mounted_photos(reconstruction)  # their rig holds them
    if wanted := [name for name in _to_register(figures) if name not in mounted]:
        model, attempts = register_weak_views(
            now.model,
            wanted,
            images,
            refinement=refinement,
            refine_intrinsics=settings.refine_intrinsics,
            resection=resection,
        )
        if model is not now.model:
            reconstruction = model.to_colmap()
    return reconstruction, RefinementFigures(passes=figures, registrations=attempts)


def _accepted(figures: Sequence[PassFigures]) -> list[PassFigures]:
    return [done for done in figures if done.accepted]


def _to_register(figures: Sequence[PassFigures]) -> list[str]:
    """The images that were weak in any pass, or doubtful in the last one.

    What little agreed in the first pass looks like much in the next (58 of 153 observations after
    22 of 393, and the camera 0.4 m off).
    """
    accepted = _accepted(figures)
    weak = {name for done in accepted for name in done.weak_views}
    return sorted(weak.union(*(done.doubtful_views for done in accepted[-1:])))
