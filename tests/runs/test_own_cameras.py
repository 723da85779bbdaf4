"""Where shared cameras do not do, each photo has its own."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import pytest

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.runs.mapping_looks import _with_own_cameras
from jaxsfm.runs.run_stages import MappedRun


@dataclasses.dataclass(frozen=True)
class Mapped:
    """A `MappedRun`, as far as its rank is asked for."""

    looks_right: bool
    registered: int

    @property
    def photos(self) -> list[range]:
        return [range(self.registered)]

    def green(self) -> bool:
        return self.looks_right

    def doubted(self) -> bool:
        return not self.looks_right

    better_than, largest = MappedRun.better_than, MappedRun.largest


@dataclasses.dataclass(frozen=True)
class Stages:
    """`RunStages` whose models depend on the cameras alone."""

    cameras: Cameras
    own: Mapped
    images: list = dataclasses.field(default_factory=list)
    look: str = ""

    def map(self, matched: object) -> Mapped:
        assert self.cameras.sharing == "photo" and self.look == "-own-cameras"
        return self.own


@pytest.fixture(autouse=True)
def shared(monkeypatch):
    monkeypatch.setattr(Cameras, "groups", lambda self, images: [images])


def choose(
    mapped: Mapped, own: Mapped, cameras: Cameras | None = None, photos: Sequence[int] = (1, 2)
) -> Mapped:
    stages: Any = Stages(cameras or Cameras(), own, images=[*photos])
    matched: Any = None
    made: Any = mapped
    found, chosen = _with_own_cameras(matched, made, stages)
    assert (found is not stages) == (chosen is own)
    return chosen  # pyright: ignore


GREEN, AMBER, FEW = Mapped(True, 18), Mapped(False, 18), Mapped(True, 12)


@pytest.mark.parametrize(
    ("mapped", "own", "better"),
    [
        (AMBER, GREEN, True),
        (FEW, GREEN, True),
        (AMBER, Mapped(False, 18), False),
        (FEW, AMBER, False),
    ],
)
def test_the_better_model_is_kept_and_of_equal_ones_that_of_shared_cameras(mapped, own, better):
    assert choose(mapped, own) is (own if better else mapped)


@pytest.mark.parametrize(
    "cameras",
    [
        Cameras(sharing="single"),
        Cameras(sharing="folder"),
        Cameras(sharing="photo"),
        Cameras(known=Intrinsics(model="PINHOLE", params=(1.0, 1.0, 1.0, 1.0))),
    ],
    ids=["single", "folder", "photo", "known"],
)
def test_what_the_user_has_said_of_the_cameras_is_kept(cameras):
    assert choose(AMBER, GREEN, cameras) is AMBER


@pytest.mark.parametrize(("shared", "tried"), [(1, False), (2, False), (3, True)])
def test_cameras_that_few_photos_share_are_not_why_a_model_is_bent(monkeypatch, shared, tried):
    """Of four photos, some share a camera."""
    photos = [1, 2, 3, 4]
    groups = [photos[:shared], *([photo] for photo in photos[shared:])]
    monkeypatch.setattr(Cameras, "groups", lambda self, images: groups)
    assert choose(AMBER, GREEN, photos=photos) is (GREEN if tried else AMBER)
