"""The part of a run's report that says what came of its photos, pairs and models."""

import dataclasses
import enum
from dataclasses import field
from typing import Literal

from jaxsfm.io.pairs import Pair
from jaxsfm.report.typed_json import OMITTED, Count, Number
from jaxsfm.sfm.evaluation import PoseError
from jaxsfm.sfm.view_graph import Verdict

Stage = Literal[
    "pairs",
    "too few matches",
    "no plane",
    "not connected",
    "no pose",
    "not confirmed",
    "other model",
]
"""The stage at which a photo was lost (`jaxsfm.report.lost_photos` explains each)."""


class PairStatus(enum.StrEnum):
    """How the matching of a pair ended: the names of `jaxsfm.core.types.Status`."""

    VERIFIED = enum.auto()
    TOO_FEW_MATCHES = enum.auto()
    NO_PLANE = enum.auto()


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairRow:
    """The numbers of one pair of photos."""

    pair: Pair
    status: PairStatus
    tentative: Count
    """Tentative matches."""
    inliers: Count
    """Matches on a plane: the inliers of the pair's homographies."""
    planes: Count
    """Homographies."""
    handed_on: bool
    """Whether the matches were written into COLMAP's database."""
    colmap_inliers: Count
    """Inliers of the two-view geometry that COLMAP found; 0 if it found none."""
    view_graph: Verdict | None
    """What the view graph says of the pair; None if it did not judge the pair."""

    @property
    def verified(self) -> bool:
        """Whether COLMAP verified the pair."""
        return self.colmap_inliers > 0

    @property
    def trusted(self) -> bool:
        """Whether the pair was given to the mapper."""
        return self.verified and (self.view_graph is None or self.view_graph.trusted)

    @property
    def outvoted(self) -> bool:
        """Whether the view graph dropped the pair, so that `--view-graph no` keeps it."""
        verdict = self.view_graph
        return self.verified and verdict is not None and not (verdict.trusted or verdict.rejected)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TriedPairs:
    """All pairs of photos that were tried, and how far they came."""

    tried: Count
    verified: Count
    """Pairs with matches on a plane."""
    handed_on: Count
    trusted: Count | None = None
    """Pairs that the view graph trusts; None if it was switched off."""
    overflowed: Count
    """Pairs that had more matches than could be kept."""
    each: list[PairRow]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelRow:
    """The numbers of one COLMAP model."""

    registered: Count
    """Photos with a pose."""
    points: Count
    observations: Count | None = None
    track_length: Number
    """Mean number of photos that see a point."""
    reprojection_error_px: Number
    """Mean over the points, pixels."""
    images: list[str]
    """The names of the photos with a pose, sorted."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClosestPair:
    """The pair of a photo, or of a group of photos, that came furthest."""

    component: Count | None = field(default=None, metadata=OMITTED)
    """The other group that the pair leads to, as an index into `ViewGraph.components`."""
    pair: Pair
    tentative: Count | None = None
    inliers: Count | None = None
    colmap_inliers: Count | None = None
    trusted: bool | None = None
    edge_weight: Number | None = None
    rotation_error_deg: Number | None = None
    missed: str
    """What the pair lacks to be used, in words; empty if it was used."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Component:
    """A group of photos that chains of trusted pairs join."""

    images: list[str]
    pairs: Count
    """Trusted pairs inside the group."""
    registered: Count
    """Photos of the group in the best model."""
    nearest: ClosestPair | None
    """The pair that comes nearest to joining the group to another; None if none was tried."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacedPanoramas:
    """The panoramas of a run, whose views are among its photos."""

    found: Count
    """Those that could be used."""
    registered: Count
    """Those with a pose in the best model."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewGraph:
    """The groups of photos that trusted pairs join."""

    components: list[Component] = field(default_factory=list)
    """The largest first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """Something that could bring a lost photo into the model."""

    option: str | None
    """An option of the command line; None if only other photos would help."""
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class LostPhoto:
    """A photo without a pose in the best model."""

    image: str
    stage: Stage
    detail: str
    """The numbers that decided, in words."""
    component: Count | None = None
    """The photo's group, as an index into `ViewGraph.components`."""
    model: Count | None = None
    """The smaller model that the photo is in (`sparse/N`)."""
    best_pair: ClosestPair | None = None
    help: list[Advice] | None = field(default=None, metadata=OMITTED)
    """None in reports of versions that gave no advice."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ErrorSummary:
    """Errors of several photos."""

    mean: Number
    median: Number
    max: Number


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationReport:
    """The errors of a model against reference poses (`jaxsfm.sfm.evaluation.Evaluation`)."""

    registered: Count
    """Photos of the reference with a pose in the model."""
    reference_images: Count
    """All photos of the reference; of a run, those that it was given."""
    aligned_on: Count
    """Photos whose camera centres the model was aligned on."""
    position: ErrorSummary
    """Units of the reference."""
    rotation_deg: ErrorSummary
    """Degrees."""
    within_10deg: dict[str, Number]
    """Share of the reference's photos within a distance (the key, in units of the reference) and
    10 degrees."""
    images: dict[str, PoseError]
    missing: list[str] = field(default_factory=list)
    """Photos of the reference without a pose in the model."""
