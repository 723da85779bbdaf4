"""The report of a run: what is written into report.json, and read from it again.

Pixels are those of the original photos unless a field says otherwise. A field with a default may be
missing in the report of an earlier version.
"""

import dataclasses
import functools
import json
from dataclasses import field
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
from msgspec import Meta

from jaxsfm.colmap.mapper import Attempt
from jaxsfm.errors import UserError
from jaxsfm.io.atomic import Json, write_atomic
from jaxsfm.io.typed_files import read_json
from jaxsfm.report.old_names import with_new_names
from jaxsfm.report.run_inputs import (
    FoundPhotos,
    LowResolution,
    RecordedOptions,
    RunIdentity,
    SamePixels,
    UsedExternalMatches,
    UsedWeights,
)
from jaxsfm.report.run_results import (
    EvaluationReport,
    LostPhoto,
    ModelRow,
    PlacedPanoramas,
    TriedPairs,
    ViewGraph,
)
from jaxsfm.report.typed_json import OMITTED, Count, Number, to_json
from jaxsfm.sfm.check.model_check import MIN_VIEWS, ModelCheck, VerdictColour
from jaxsfm.sfm.georeference.georeference import Georeference
from jaxsfm.sfm.refine.passes import RefinementFigures

FILE = "report.json"
FORMAT = 3
"""The version of the format. Reports of format 1 have no key `format`. In those of format 2, some
keys have other names (`jaxsfm.report.old_names`)."""
T = TypeVar("T")
_WORST_FIRST: tuple[VerdictColour, ...] = ("red", "amber", "green")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extension:
    """One call of `jaxsfm extend`."""

    finished: str
    """Date and time, UTC."""
    added: list[str]
    """New photos that could be used."""
    registered: list[str]
    """Those of `added` that have a pose now."""
    skipped: list[str]
    """New files that could not be used."""
    rounds: Count
    pairs: Count
    """Pairs that were tried."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Options:
    """The options, as a part of the report: an error says so of its place."""

    options: RecordedOptions


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunReport:
    """Everything that is told about a run, except its model and its matches."""

    format: Annotated[int, Meta(ge=1, le=FORMAT)] = 1
    version: str
    """The version of jaxsfm."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of jaxsfm and of the packages below it, the system and the devices."""
    finished: str = ""
    """Date and time, UTC."""
    identity: RunIdentity
    weights: UsedWeights
    options: dict[str, object]
    """All options, some of which may be unknown to this version (`known_options`)."""
    images: FoundPhotos
    pairs: TriedPairs
    given: UsedExternalMatches | None = None
    low_resolution: LowResolution | None = field(default=None, metadata=OMITTED)
    """None: all photos were described at the size of the config."""
    turned: dict[str, Annotated[int, Meta(ge=1, lt=360)]] = field(
        default_factory=dict, metadata=OMITTED
    )
    """By how many degrees photos are turned clockwise to be upright, by name: those that the run
    found to be stored sideways without a note in EXIF."""
    same_pixels: SamePixels | None = field(default=None, metadata=OMITTED)
    """What shows at the same pixels in all photos; None: nothing, or masks were given."""
    models: list[ModelRow]
    """The one with most photos first, as the run made them; `jaxsfm extend` keeps this order. Empty
    if there is none."""
    panoramas: PlacedPanoramas | None = field(default=None, metadata=OMITTED)
    """None if no photo was one."""
    mapping: list[Attempt] = field(default_factory=list)
    """Every start of the mapper."""
    refinement: list[RefinementFigures | None] = field(default_factory=list)
    """One for each model; None for a model that was not refined."""
    checks: list[ModelCheck | None] = field(default_factory=list)
    """One for each model; None for a model that was not checked. Empty after `jaxsfm extend`."""
    georeference: Georeference | None = field(default=None, metadata=OMITTED)
    """How the models were moved into metres; None if nothing was measured, or it was not asked
    for."""
    view_graph: ViewGraph = field(default_factory=ViewGraph)
    lost: list[LostPhoto]
    """Sorted by name."""
    no_model: str | None = None
    """Why there is no model; None if there is one."""
    seconds: dict[str, Number]
    """Wall-clock time of each stage, seconds."""
    evaluation: EvaluationReport | None = field(default=None, metadata=OMITTED)
    """Errors against the reference poses; None without reference poses."""
    evaluation_failed: str | None = field(default=None, metadata=OMITTED)
    """Why the model could not be compared with the reference poses."""
    extended: list[Extension] | None = field(default=None, metadata=OMITTED)
    """Calls of `jaxsfm extend` since the run."""

    def __post_init__(self) -> None:
        _ = self.known_options  # raises msgspec.ValidationError if they cannot be read

    @functools.cached_property
    def known_options(self) -> RecordedOptions:
        """Those of the options that readers need."""
        return msgspec.convert({"options": self.options}, _Options).options

    def photos(self) -> set[str]:
        """The names of all photos that the run was given, those that it could not use included."""
        placed = (name for model in self.models for name in model.images)
        return {*self.identity.images, *self.images.skipped, *placed}

    @property
    def in_metres(self) -> bool:
        """Whether the best model was moved into metres."""
        found = self.georeference
        return found is not None and bool(found.models) and found.models[0].similarity is not None

    @property
    def checked(self) -> list[tuple[int, ModelCheck]]:
        """The models that were checked and have enough photos for a verdict: the number N of the
        folder `sparse/N`, and the check."""
        # Checks may be empty. The refinement may have taken photos out of a model since.
        rows = enumerate(zip(self.models, self.checks, strict=False))
        return [
            (number, check)
            for number, (model, check) in rows
            if check is not None and model.registered >= MIN_VIEWS
        ]

    @property
    def verdict(self) -> VerdictColour | None:
        """The worst verdict on the models in `checked`; None if there are none.

        It is amber at least if the photos contradict the measured positions of a file.
        """
        found: set[VerdictColour] = {check.verdict for _, check in self.checked}
        placed = self.georeference.models if self.georeference else []
        if any(model.contradicted for model in placed):
            found.add("amber")
        return next((colour for colour in _WORST_FIRST if colour in found), None)

    def to_json(self) -> dict[str, Json]:
        """The report as plain JSON."""
        return to_json(self)

    @classmethod
    def from_json(cls, value: object) -> "RunReport":
        """A report from plain JSON; msgspec.ValidationError if this version cannot read it."""
        return msgspec.convert(with_new_names(value), cls)


def write_report(folder: Path, report: RunReport) -> None:
    """Write a run's report.json."""
    write_atomic(folder / FILE, json.dumps(report.to_json(), indent=1).encode())


def read_report(folder: Path) -> RunReport:
    """Read a run's report.json; errors are those of `read_part`."""
    return read_part(folder, RunReport)


def read_part(folder: Path, kind: type[T], *keys: str) -> T:
    """Read the part of a run's report.json that `keys` lead to, whatever the rest of the file is.

    Raises:
      UserError: there is no report, or the part is damaged or of another version.
    """
    value = with_new_names(read_json(folder / FILE, object))
    if value is None:
        raise UserError(f"{folder}: no finished run here ({FILE} is missing or damaged)")
    try:
        for key in keys:
            if not isinstance(value, dict) or key not in value:
                raise ValueError(f"the key {key!r} is missing")
            value = value[key]
        return msgspec.convert(value, kind)
    except ValueError as error:
        raise UserError(
            f"{folder}: {FILE} is damaged, or of another version of jaxsfm ({error})"
        ) from error
