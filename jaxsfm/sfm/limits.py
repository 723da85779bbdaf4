"""The numbers by which steps of the road decide about photos, pairs and models, step by step.

Other numbers stand where they are used. How many photos a mapping may leave out, and from which
pairs it may start, is said in `jaxsfm.colmap.mapper`; when a model is doubted in
`jaxsfm.sfm.check.grouping`; how patches are compared in `jaxsfm.sfm.check.agreement`; when a view
is weak in `jaxsfm.sfm.refine.one_pass`; and how a pose is followed and trusted in
`jaxsfm.sfm.refine.octave_pose`.
"""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class UprightLimits:
    """Photos that are stored sideways."""

    trial_px: int = 400
    """Longer side of the photos in a trial, pixels. A trial of a photo then costs about as much as
    its description at 800 px."""
    partners: int = 8
    """So many photos of the largest group are matched with the photo that is tried. A group may be
    a walk around a building, so a few of them might show other sides."""
    least_inliers: int = 60
    """A pair is strong if it has so many verified matches, and `TrustLimits.strong` of the edge
    weight that it could have. A turn is believed with so many matches, summed over all partners.
    Two photos of different things often have one plane of 26 matches by accident, rarely two."""
    times_others: float = 1.5
    """... and if it has so many times the matches of any other turn. Photos beside far partners
    of their sets: a wrong turn never had more than 0.91 times those of the right one
    (docs/decisions/photos.md)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnePlaceLimits:
    """Whether all photos were taken from one place.

    The figures are those of docs/decisions/photos.md: five sets that were turned on one spot, and
    33 others. Of the others, the neighbouring frames of a video come nearest to a turn.
    """

    pairs: int = 12
    """So many pairs are compared, spread over all verified ones."""
    start_px: float = 4.0
    """Largest error of a match with the homography that the alignment starts from, pixels of the
    described photos: COLMAP's own limit for verified matches."""
    correlation: float = 0.8
    """A window is aligned if its pixels correlate better."""
    aligned: float = 0.9
    """A turn aligns at least this share of the windows. Moving things may hide some."""
    eigenvalues: float = 0.001
    """Largest logarithm of an eigenvalue of a turn. Pairs of turned photos have 0.0002 or less, and
    neighbouring frames of kitchen 0.0018 in the median."""
    singular_values: float = 0.01
    """Largest logarithm of a singular value of a turn, for the focal length that fits most pairs.
    Pairs of turned photos have 0.005 or less: half of it is the step of `FOCALS`, the rest what the
    principal point and a lens may do. Parts of one photo, as a camera takes them that moves along a
    plane without turning, have 0.02 or more."""
    share: float = 0.75
    """Photos are from one place if at least this share of the pairs differs by a turn only: all
    pairs of turned photos do, and 0 to 33 % of those of other sets."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrustLimits:
    """Which pairs are trusted."""

    strong: float = 0.3
    """In the first mapping, a pair with so large an edge weight may have any rotation. False pairs
    reached 0.09 before weak ones lost weight (`weak`)."""
    weak: float = 0.25
    """A pair loses half of its edge weight if its weight is this share of the median of all images'
    best pairs."""
    steepness: float = 2.5
    """A pair keeps 1 / (1 + (h / weight) ^ steepness) of its edge weight, where h is `weak` times
    the median weight of all images' best pairs. In 30 runs of castle-P19 at five sizes, 461 of 2982
    false pairs were trusted without this, and 2 are with it (docs/decisions/view-graph.md)."""
    rotation_deg: float = 15.0
    """Largest error of a trusted pair's rotation against the averaged ones, unless the pair is
    strong. Two-view rotations of true pairs are off by 0.3 deg (median), those of weak pairs by
    10."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OrderLimits:
    """When the names of photos say in which order they were taken."""

    equal_steps: float = 0.5
    """Numbers are those of a sequence if so many of their steps are equal: some photos may be
    missing, but the identifiers of a photo site have no equal steps."""
    least_numbered: int = 5
    """Fewer photos have no order worth following."""
    numbered_share: float = 0.5
    """The order says how to join all photos if so many of them are numbered. Of the 135 photos of
    statue, 8 are: frames of a video."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckLimits:
    """Whether the photos of a model agree with it."""

    fit: float = 0.5
    """A pair agrees with a model if at least this share of its matches fits."""
    lower_fits: tuple[float, ...] = (0.25, 0.1)
    """If no such pair joins two groups that contradict each other, they were joined by pairs of
    which less fits, and the limit is lowered in these steps. On castle-P19 at 600 px with the
    preset `robust`, no false pair fits by a half, because the mapper has bent the model between
    them."""
    least_matches: int = 15
    """A pair with fewer matches on the surface of the model says nothing: the fewest inliers that
    COLMAP verifies."""
    least_tested: int = 30
    """Fewer tested points say nothing about two groups."""
    least_contradicted: int = 10
    """Fewer contradictions between two photos do not reject their pair."""
    least_shared: int = 100
    """Two groups that do not contradict each other are one part if they see at least so many of the
    same points. False pairs give common points, too. On *statue*, 48 pairs of groups have 30 common
    points or more; 15 of the 25 wrong ones and 4 of the 23 right ones have fewer than 100."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseAmbiguityLimits:
    """Whether a photo fits into a model in a second place."""

    least_inliers: int = 30
    """Fewer matches give no second place: the fewest inliers from which COLMAP's mapper adds a
    photo."""
    least_support: int = 15
    """A pair speaks for a second place if so many of its matches agree with it: the fewest inliers
    that COLMAP verifies."""
    inlier_share: float = 0.25
    """Some pairs of a photo do not agree with the model. At least this share of their matches must
    agree with the second place. Looking for rarer ones took ten of forty seconds on castle-P19."""
    tested_per_view: int = 250
    """The points of the model, per view, that are tested in a second place."""
    least_agreed: int = 50
    """The least number of points that the photo must show, seen from its second place."""
    rotation_deg: float = 15.0
    """A place is another one if it is turned by more than trusted rotations may differ..."""
    distance_share: float = 0.2
    """... or moved by more than this share of the distance to the points that it shows."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RegisterLimits:
    """The registration of photos that have no place."""

    shortlist: int = 20
    """A photo is located among so many photos at most, as `extend` does by default: first those
    with a place, and of these first those with most matches."""
    partners: int = 3
    """A lost photo is matched at full size with so many others. Each pair takes up to a minute on
    two cores."""
    significance: float = 60.0
    """Matches of a pair count if they have at least this significance. They are more often wrong
    than right then: alignment has to confirm the place that they give."""
    contradicted_share: float = 0.15
    """A place is doubtful if the view contradicts a larger share of the points that it should show.
    Of 79 views of right models (castle-P19 at 1280 px, Sacre Coeur, kitchen), three do so to more
    than 0.09, with 12, 35 and 106 points; a view before the wrong wall of a rendered box, to 0.25.
    """
    least_contradicted: int = 50
    """Fewer points are no reason to doubt a place: they may be passers-by."""
    partners_without_model: int = 10
    """If no model was made of photos at a small size, each photo is matched with so many others at
    full size: those with which it has most matches."""


UPRIGHT, ONE_PLACE = UprightLimits(), OnePlaceLimits()
TRUST, ORDER = TrustLimits(), OrderLimits()
CHECK, POSE_AMBIGUITY, REGISTER = CheckLimits(), PoseAmbiguityLimits(), RegisterLimits()
