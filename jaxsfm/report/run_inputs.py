"""The part of a run's report that says what the run was made with."""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import field
from typing import Annotated, TypeVar

from msgspec import Meta

from jaxsfm.io.entries import STILL
from jaxsfm.io.images import ImageFile, orientations
from jaxsfm.io.photo_folder import masks_of
from jaxsfm.report.typed_json import OMITTED, Count, Number

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunIdentity:
    """What the matches of a run depend on: as JSON it is a `jaxsfm.io.store.Identity`."""

    version: str
    """The version of jaxsfm."""
    weights: str | None = None
    """SHA-256 of the network's weights."""
    relocalizer: str | None = None
    """SHA-256 of the learned relocalizer; None if the run used none."""
    config: dict[str, object]
    """The part of the config that matches depend on (`Config.matching`)."""
    seed: Count = 0
    images: dict[str, str]
    """The SHA-256 of every usable photo, by name."""
    orientations: dict[str, Count] = field(default_factory=dict, metadata=OMITTED)
    """How photos that are not stored upright are turned, by name (`jaxsfm.io.orientation`)."""
    masks: dict[str, str] = field(default_factory=dict, metadata=OMITTED)
    """The SHA-256 of the masks, by the names of their photos."""

    def with_images(self, images: Iterable[ImageFile]) -> "RunIdentity":
        """The same run with these images, which replace those of the same names."""
        new = {image.name: image for image in images}

        def others(values: Mapping[str, T]) -> dict[str, T]:
            return {name: value for name, value in values.items() if name not in new}

        return dataclasses.replace(
            self,
            images=self.images | {name: image.sha256 for name, image in new.items()},
            orientations=others(self.orientations) | orientations(new.values()),
            masks=others(self.masks) | masks_of(new.values()),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class UsedWeights:
    """The network and the relocalizer of a run."""

    backbone: str | None = None
    family: str | None = None
    source: str | None = None
    sha256: str | None = None
    relocalizer_sha256: str | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedConfig:
    """The fields of a run's `Config` that readers of reports of any version need."""

    max_size: Annotated[int, Meta(ge=1, lt=2**31)]
    """Longer side of a working image, pixels."""
    enlarge: Annotated[float, Meta(ge=1, lt=2**31)]
    """The largest factor by which a smaller photo was enlarged."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedOptions:
    """The options of a run that readers of reports of any version need."""

    config: RecordedConfig
    pairs: str
    """The value of `--pairs`, or what its value `auto` stood for."""
    intrinsics: str | None
    """The value of `--intrinsics`; None if the focal lengths were estimated."""
    seed: Count
    threads: Annotated[int, Meta(ge=-1, lt=2**31)]
    """The number of threads; -1 stands for all."""
    reference: str | None = None
    """The path of the reference poses."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoFolder:
    """The folder of the photos of a run."""

    folder: str | None = None
    """Its absolute path; None if it is not known."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundPhotos(PhotoFolder):
    """The files that the run found in the folder of photos."""

    found: Count
    usable: Count
    skipped: dict[str, str]
    """Why a file could not be used, by name."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LowResolution:
    """The sizes at which the photos of a run were described."""

    px: Count
    """The longer side of the photos at first, pixels."""
    whole: bool = False
    """Whether photos of this size gave no model, so that they were matched at full size."""

    def in_words(self) -> str:
        """At what size the photos were described, in a sentence without a full stop."""
        if self.whole:
            return f"no model was made of photos of {self.px} px, so they were matched at full size"
        return f"photos were described at {self.px} px"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SamePixels:
    """Pixels at which all photos of one size show the same (`jaxsfm.io.still_pattern`)."""

    share: Number
    """Their share of all pixels."""
    photos: Count
    """The number of photos of this size."""

    def in_words(self) -> str:
        """What they are and what to do, in a sentence without a full stop."""
        return (
            f"{100 * self.share:.0f} % of the pixels show the same in {self.photos} photos; if "
            "this is no part of the scene (a watermark, a dashboard, the wall behind a turntable), "
            f"leave it out: run the same command again with --masks and the file {STILL} of this "
            "folder"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class UsedExternalMatches:
    """The matches of another tool that were mapped together with the run's own."""

    files: list[str]
    sha256: list[str]
    verified: bool
    """Whether the other tool had verified them."""
    images: Count
    ignored: list[str]
    """Images of the other tool that are not among the photos."""
    pairs: Count
    matches: Count
