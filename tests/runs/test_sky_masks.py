"""Masks of the sky, and when a run tries them."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_runs import Mapped, Matched, Photos, Stages, image

from jaxsfm.io.images import ImageError, ImageFile
from jaxsfm.io.masks import MaskFile, read_mask
from jaxsfm.runs import mapping_looks, sky_masks
from jaxsfm.runs.mapping_looks import map_in_looks
from jaxsfm.runs.sky_masks import without_sky


@pytest.fixture
def skies(monkeypatch):
    """Says how much of each photo shows the sky, in hundredths."""

    def of(shares: dict[str, int]) -> None:
        def below_sky(image: ImageFile) -> np.ndarray:
            return (np.arange(100) >= shares[image.name]).reshape(10, 10)

        monkeypatch.setattr(sky_masks, "below_sky", below_sky)

    return of


def test_photos_that_show_the_sky_get_masks_of_the_rest(tmp_path, skies):
    skies({"sub/a.jpg": 40, "b.jpg": 6, "c.jpg": 5, "d.jpg": 95})
    folder = tmp_path / "sky"
    images = [*map(image, ["sub/a.jpg", "b.jpg", "c.jpg", "d.jpg"])]
    found = without_sky(images, sky_masks.sky_masks(images), folder)
    assert [*found] == ["sub/a.jpg", "b.jpg"]
    mask = found["sub/a.jpg"].mask
    assert mask is not None and mask.path == folder / "sub/a.jpg.png"
    assert read_mask(mask).sum() == 60
    assert sorted(p.name for p in tmp_path.rglob("*.png")) == ["a.jpg.png", "b.jpg.png"]


def test_masks_are_not_made_if_few_photos_show_the_sky(skies):
    skies({"a": 40, "b": 0, "c": 0})
    assert sky_masks.sky_masks(map(image, "abc")) == {} == sky_masks.sky_masks([])


def test_a_photo_that_cannot_be_decoded_gets_no_mask_and_old_masks_go(tmp_path, monkeypatch):
    def below_sky(image: ImageFile) -> np.ndarray:
        if image.name == "c":
            raise ImageError("c: damaged")
        return np.arange(100).reshape(10, 10) >= 40

    monkeypatch.setattr(sky_masks, "below_sky", below_sky)
    folder = tmp_path / "sky"
    folder.mkdir()
    (folder / "old.png").touch()
    images = [*map(image, "abc")]
    assert [*without_sky(images, sky_masks.sky_masks(images), folder)] == ["a", "b"]
    assert sorted(path.name for path in folder.iterdir()) == ["a.png", "b.png"]


def test_masks_of_the_user_are_believed(skies):
    skies({"a": 40, "b": 40})
    own = dataclasses.replace(image("a"), mask=MaskFile(Path("m.png"), "m"))
    assert sky_masks.sky_masks([own, image("b")]) == {}


@pytest.mark.parametrize(
    ("first", "second", "masked"),
    [
        (Mapped(False, 55), Mapped(False, 108), 2),
        (Mapped(False, 20), Mapped(True, 18), 2),
        (Mapped(False, 20), Mapped(True, 17), 0),  # much fewer photos
        (Mapped(False, 2), Mapped(True, 2), 0),  # too small to be checked
        (Mapped(False, 0), Mapped(True, 0), 0),
        (Mapped(False, 55), Mapped(False, 55), 0),
        (Mapped(False, 55), Mapped(False, 54, few_apart=True), 2),
        (Mapped(True, 12), Mapped(True, 20), None),
        (Mapped(False, 12, few_apart=True), Mapped(True, 20), None),
    ],
)
def test_the_sky_is_masked_if_this_helps_where_something_speaks_against_the_model(
    monkeypatch, tmp_path, skies, first, second, masked
):
    """None stands for not tried."""
    skies({"a": 40, "b": 40})
    monkeypatch.setattr(mapping_looks, "find_turned", lambda *_: {})
    images = {name: image(name) for name in "ab"}
    photos: Any = Photos(images, SimpleNamespace(config=Matched.described))
    stages: Any = Stages(
        {"": first, "-sky": second}, [*images.values()], SimpleNamespace(path=tmp_path)
    )
    matched: Any = Matched("")
    found = map_in_looks(photos, matched, stages)
    assert found.masked_sky == (masked or 0) and (tmp_path / "sky").exists() == bool(masked)
    assert photos.tried == (["-sky"] if masked is not None else [])
    assert found.mapped is (second if masked else first)
    assert found.matched == ("-sky" if masked else "")


@pytest.mark.parametrize(
    ("masked", "expected"), [(Mapped(False, 60), "-sky"), (Mapped(False, 55), "-all-rounds")]
)
def test_rounds_that_ended_early_are_made_if_masks_of_the_sky_do_not_help(
    monkeypatch, tmp_path, skies, masked, expected
):
    skies({"a": 40, "b": 40})
    monkeypatch.setattr(mapping_looks, "find_turned", lambda *_: {})
    images = {name: image(name) for name in "ab"}
    made = {"": Mapped(False, 55, cut_short=True), "-sky": masked, "-all-rounds": Mapped(True, 50)}
    photos: Any = Photos(images, SimpleNamespace(config=Matched.described))
    stages: Any = Stages(made, [*images.values()], SimpleNamespace(path=tmp_path))
    matched: Any = Matched("")
    found = map_in_looks(photos, matched, stages)
    assert found.mapped is made[expected] and bool(found.masked_sky) == (expected == "-sky")


@pytest.mark.parametrize(
    ("masked", "looked_again"),
    [
        (Mapped(False, 108), False),
        (Mapped(False, 108, few_apart=True, in_no_model="one"), True),
        (Mapped(True, 60, many_lost=True, in_no_model="one"), True),
        (Mapped(True, 60, many_lost=True, in_no_model="many"), True),
        (Mapped(False, 50), True),  # the sky is not masked, as this gives no better model
    ],
)
def test_with_the_sky_masked_not_all_pairs_are_looked_at_again(
    monkeypatch, tmp_path, skies, masked, looked_again
):
    """Such a model is amber at best, so nothing can be settled; single photos can."""
    skies({"a": 40, "b": 40})
    monkeypatch.setattr(mapping_looks, "find_turned", lambda *_: {})
    monkeypatch.setattr(mapping_looks, "match_again", lambda *_: Matched("again"))
    images = {name: image(name) for name in "ab"}
    full_size = SimpleNamespace(config=SimpleNamespace(checked=True))
    made = {"": Mapped(False, 60), "-sky": masked, "again": Mapped(True, 110)}
    photos: Any = Photos(images, full_size)
    stages: Any = Stages(made, [*images.values()], SimpleNamespace(path=tmp_path))
    found = map_in_looks(photos, Matched(""), stages)  # pyright: ignore[reportArgumentType]
    assert found.looks is not None and found.looks.photos == ["a"]
    assert bool(found.looks.again) == looked_again
    few = masked.in_no_model != "many" and found.masked_sky
    assert found.looks.whole == (looked_again and not few)
    assert found.mapped is (made["again"] if looked_again else masked)
    assert ("no pair was matched again" in found.looks.in_words()) != looked_again


def test_with_the_sky_masked_photos_of_every_model_have_a_place(monkeypatch, tmp_path, skies):
    """Also if most are not in the best one."""
    skies({"a": 40, "b": 40})
    monkeypatch.setattr(mapping_looks, "find_turned", lambda *_: {})
    images = {name: image(name) for name in "ab"}
    full_size = SimpleNamespace(config=SimpleNamespace(checked=True))
    made = {"": Mapped(False, 60), "-sky": Mapped(True, 60, many_lost=True)}
    photos: Any = Photos(images, full_size)
    stages: Any = Stages(made, [*images.values()], SimpleNamespace(path=tmp_path))
    found = map_in_looks(photos, Matched(""), stages)  # pyright: ignore[reportArgumentType]
    assert found.mapped is made["-sky"] and found.looks is not None and not found.looks.photos
