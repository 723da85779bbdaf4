"""Runs that are made of numbers, for laws of what follows which look."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from jaxsfm.io.images import ImageFile
from jaxsfm.runs import sky_masks
from jaxsfm.runs.mapping_looks import RunPhotos
from jaxsfm.runs.run_stages import MappedRun
from jaxsfm.sfm.second_look import SecondLook

SIZE = (10, 10)


def image(name: str) -> ImageFile:
    return ImageFile(name=name, path=Path(name), size=SIZE, sha256=name)


class Matched(str):
    """The matches of a look, which described the photos at full size."""

    described = SimpleNamespace(checked=True, max_size=800)
    counts: dict = {}


@dataclasses.dataclass(frozen=True)
class Mapped:
    """Models with so many photos in the best one."""

    right: bool
    size: int
    few_apart: bool = False
    """Only photos that follow each other speak against it."""
    many_lost: bool = False
    """More than a third of the photos are not in the best model."""
    in_no_model: str = ""
    """Whether photos are in no model: one, or many, which are more than a third."""
    cut_short: bool = False
    places: int = 1
    """So many models are large enough to be checked."""

    @property
    def stage(self) -> SimpleNamespace:
        return SimpleNamespace(figures=SimpleNamespace(cut_short=self.cut_short))

    @property
    def photos(self) -> list[range]:
        return [range(self.size)] if self.size else []

    def green(self) -> bool:
        return self.right

    def doubted(self) -> bool:
        return not (self.right or self.few_apart)

    def settled(self) -> bool:
        return True  # own cameras are not tried

    def checked_models(self) -> list[set[str]]:
        return [{f"{k}{n}" for n in "ab"} for k in range(self.places)]

    def unsettled(
        self, counts: dict, models: list | None = None, *, places: bool = False
    ) -> SecondLook | None:
        whole = self.many_lost or not self.few_apart
        if models and not self.doubted():  # otherwise nothing is settled
            lost = set().union(*self.checked_models()).difference(*models)
            if not lost and not self.in_no_model:
                return None
            photos, whole = sorted(lost) or ["a"], self.in_no_model == "many"
            return SecondLook(photos, [("a", "b")], whole=whole and not places)
        return SecondLook(["a"], [("a", "b")], whole=whole)

    better_than, largest = MappedRun.better_than, MappedRun.largest


@dataclasses.dataclass(frozen=True)
class Stages:
    made: dict[str, Mapped]
    images: list[ImageFile]
    folder: Any
    look: str = ""
    seconds: dict = dataclasses.field(default_factory=dict)

    def map(self, matched: object, go_on: Callable[[], bool] | None = None) -> Mapped:
        if matched == "again":
            return self.made["again"]
        if self.look == "-all-rounds":
            assert go_on is None and not any(image.mask for image in self.images)
            return self.made[self.look]
        if go_on is not None:
            assert self.look == "" and not go_on()  # the sky can be masked
        assert matched == self.look and all(i.mask for i in self.images) == (self.look == "-sky")
        return self.made[self.look]


@dataclasses.dataclass(frozen=True)
class Photos:
    images: dict[str, ImageFile]
    job: Any
    identity: str = ""
    look: str = ""
    tried: list[str] = dataclasses.field(default_factory=list)

    def with_images(self, changed: dict[str, ImageFile]) -> "Photos":
        return dataclasses.replace(self, images={**self.images, **changed}, look="-sky")

    def match(self, seconds: dict) -> tuple["Matched", dict]:
        self.tried.append(self.look)
        return Matched(self.look), {}

    @property
    def sky_masks(self) -> dict[str, bytes]:
        return sky_masks.sky_masks(self.images.values())

    map = RunPhotos.map
