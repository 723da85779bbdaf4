"""Laws of the shortlist: it is the photos' own, whatever happened before."""

import dataclasses
import functools
import shutil
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsfm
from jaxsfm.cli.main import main
from jaxsfm.core.retrieval import partners
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError
from jaxsfm.io.pair_selection import sequential_pairs
from jaxsfm.io.pairs import exhaustive_pairs, read_pairs
from jaxsfm.io.store import Store
from jaxsfm.io.weight_files import EXTRAS
from jaxsfm.matching import global_descriptors
from jaxsfm.matching.retrieval import describe_photos, partner_pairs

KINDS = pytest.mark.parametrize("kind", ["gem", "vlad"])


@pytest.fixture(scope="module")
def folder(scene, photos, tmp_path_factory) -> Path:
    """Three views of one room, two of one picture, and one of another."""
    to = tmp_path_factory.mktemp("collection")
    shutil.copytree(scene / "images", to, dirs_exist_ok=True)
    for name, picture, at in (("c 1", 0, 0), ("c 2", 0, 16), ("d", 1, 0)):
        view = photos[picture][at : at + 240, at : at + 320, ::-1]
        cv2.imwrite(str(to / f"{name}.png"), np.ascontiguousarray(view))
    return to


@pytest.fixture(scope="module")
def images(folder):
    return jaxsfm.open_images(folder)[0]


@pytest.fixture(scope="module")
def before(weights, images, tmp_path_factory):
    """A store with all descriptors, and them."""
    store = Store(tmp_path_factory.mktemp("store"), {"version": "1", "weights": weights.sha256})
    return store, {
        k: describe_photos(weights, images, kind=k, store=store) for k in ("gem", "vlad")
    }


@pytest.fixture
def again(before, tmp_path) -> Store:
    """A copy of that store."""
    shutil.copytree(before[0].path, tmp_path / "store")
    return Store(tmp_path / "store", before[0].identity)


@pytest.fixture
def computed(monkeypatch) -> list[str]:
    """Names of the photos that go through the network from now on."""
    names: list[str] = []
    real = global_descriptors.extract_images

    def noted(weights, images, **options):
        for image, found in real(weights, images, **options):
            names.append(image.name)
            yield image, found

    monkeypatch.setattr(global_descriptors, "extract_images", noted)
    return names


def assert_same(found, wanted):
    assert found.keys() == wanted.keys()
    assert all(np.array_equal(found[name], wanted[name]) for name in wanted)


@KINDS
def test_photos_of_one_thing_find_each_other(before, kind):
    """(The room's walls show the pictures, so views of it may find those.)"""
    vectors = before[1][kind].vectors
    assert ("c 1.png", "c 2.png") in partner_pairs(vectors, 1)
    assert partner_pairs(vectors, 99) == jaxsfm.exhaustive_pairs(vectors)


def test_partners_are_chosen_of_more_photos_than_the_most_similar_ones():
    """A camera walks twice along a way, the second time in other light."""
    way = np.linspace(0, 1, 30)
    vectors = {}
    for k, light in enumerate((0.1, -0.1)):
        for i, a in enumerate(way):
            x = np.asarray([np.cos(a), np.sin(a), light], np.float32)
            vectors[f"{k} {i:02d}"] = x / np.linalg.norm(x)

    table = jnp.asarray(np.stack([*vectors.values()]))
    most_similar = np.asarray(partners(table, k=4, candidates=4))
    first, second = most_similar[: len(way)], most_similar[len(way) :]
    assert (first < len(way)).all() and (second >= len(way)).all()
    assert any(a[0] != b[0] for a, b in partner_pairs(vectors, 4))


def test_photos_of_one_frame_are_no_partners():
    """The views of a panorama overlap, so they would be the most similar ones."""
    frame_of = {f"{view} {frame}": frame for frame in range(3) for view in range(4)}
    drawn = np.random.default_rng(0).normal(size=(3, 1, 16)) + np.zeros((1, 4, 1))
    drawn += np.random.default_rng(1).normal(size=(3, 4, 16)) / 10
    vectors = {
        f"{view} {frame}": np.float32(drawn[frame, view] / np.linalg.norm(drawn[frame, view]))
        for frame in range(3)
        for view in range(4)
    }
    assert any(frame_of[a] == frame_of[b] for a, b in partner_pairs(vectors, 2))
    found = partner_pairs(vectors, 2, frame_of)
    assert found and all(frame_of[a] != frame_of[b] for a, b in found)
    every = partner_pairs(vectors, 99, frame_of)
    assert len(every) == 3 * 16


@pytest.mark.slow
def test_the_shortlist_does_not_depend_on_the_order_of_photos(weights, images, before):
    pairs = jaxsfm.shortlist(weights, images[::-1], k=1)
    assert pairs == partner_pairs(before[1]["vlad"].vectors, 1)


def test_what_is_stored_is_not_computed_again(weights, images, before, again, computed):
    for kind, wanted in before[1].items():
        assert_same(
            describe_photos(weights, images, kind=kind, store=again).vectors, wanted.vectors
        )
    assert computed == []


@KINDS
def test_what_is_damaged_is_made_again_and_equal(weights, images, before, again, computed, kind):
    image = images[2]
    for what in ("gem 480", global_descriptors.CELLS, global_descriptors._vlad_kind(images)):
        path = again._file("descriptors", what, image.sha256)
        path.write_bytes(path.read_bytes()[:-30])
    found = describe_photos(weights, images, kind=kind, store=again)
    assert computed == [image.name]
    assert_same(found.vectors, before[1][kind].vectors)


@pytest.mark.slow
def test_local_descriptors_that_went_away_meanwhile_are_made_again(
    weights, images, before, again, computed, monkeypatch
):
    """Between low-resolution matching and the vocabulary."""
    shutil.rmtree(again.path)
    real = global_descriptors._vocabulary

    def late(work, good):
        work.store._file("descriptors", global_descriptors.CELLS, good[0].sha256).unlink()
        return real(work, good)

    monkeypatch.setattr(global_descriptors, "_vocabulary", late)
    found = describe_photos(weights, images, kind="vlad", store=again)
    assert len(computed) == len(images) + 1
    assert_same(found.vectors, before[1]["vlad"].vectors)


@pytest.mark.slow
def test_a_new_photo_is_the_only_one_computed(weights, images, before, computed, tmp_path):
    store = Store(tmp_path, before[0].identity)
    describe_photos(weights, images[:-1], kind="vlad", store=store)
    computed.clear()
    found = describe_photos(weights, images, kind="vlad", store=store)
    assert computed == [images[-1].name]
    assert_same(found.vectors, before[1]["vlad"].vectors)


@KINDS
def test_a_photo_that_cannot_be_decoded_is_told_and_changes_nothing(
    weights, images, again, before, tmp_path, kind
):
    path = tmp_path / "bad.png"
    path.write_bytes(images[0].path.read_bytes()[:2000])
    bad = jaxsfm.open_images(tmp_path)[0][0]
    found = describe_photos(weights, [bad, *images], kind=kind, store=again)
    assert [image.name for image, _ in found.lost] == ["bad.png"]
    assert_same(found.vectors, before[1][kind].vectors)
    with pytest.raises(ImageError, match=r"bad\.png"):
        jaxsfm.shortlist(weights, [bad], k=1, kind=kind)


def test_copies_of_a_photo_are_described_once_and_nearest(
    weights, folder, again, computed, tmp_path
):
    shutil.copytree(folder, tmp_path / "more")
    shutil.copy(folder / "d.png", tmp_path / "more" / "a copy.png")
    images = jaxsfm.open_images(tmp_path / "more")[0]
    found = describe_photos(weights, images, kind="vlad", store=again)
    assert computed == []
    assert ("a copy.png", "d.png") in partner_pairs(found.vectors, 1)


@pytest.mark.slow
def test_netvlad_takes_the_head_of_its_weights(weights, images, monkeypatch, before, again):
    rng = np.random.default_rng(0)
    shapes = EXTRAS | {"netvlad.whitening": (512 * 64, 8), "netvlad.whitening_bias": (8,)}
    head = {name: rng.normal(size=s).astype(np.float32) / 10 for name, s in shapes.items()}
    monkeypatch.setattr("jaxsfm.matching.retrieval.check_retrieval", lambda *_: None)
    monkeypatch.setattr(global_descriptors, "read_extras", lambda _: head)
    describe = functools.partial(describe_photos, weights, images[:2], kind="netvlad", store=again)
    found = describe().vectors
    assert [v.shape for v in found.values()] == [(8,), (8,)]
    monkeypatch.setattr(global_descriptors, "read_extras", None)
    assert_same(describe().vectors, found)


def test_netvlad_without_its_head_is_refused_before_the_work(weights, images, again):
    with pytest.raises(UserError, match="--retrieval netvlad: needs NetVLAD's weights"):
        describe_photos(weights, images, kind="netvlad", store=again)


@pytest.mark.slow
def test_the_command_writes_pairs_that_a_run_reads(folder, images, before, tmp_path, capsys):
    out = tmp_path / "pairs.txt"
    plan = "retrieval:1+sequential:1"
    assert main(["pairs", str(folder), "--out", str(out), "--pairs", plan]) == 0
    names = [image.name for image in images]
    similar = partner_pairs(before[1]["vlad"].vectors, 1)
    assert read_pairs(out, names) == sorted({*similar, *sequential_pairs(names, 1)})
    assert "6 photos" in capsys.readouterr().out


def test_auto_writes_all_pairs_of_few_photos(folder, tmp_path):
    out = tmp_path / "pairs.txt"
    assert main(["pairs", str(folder), "--out", str(out), "--pairs", "auto"]) == 0
    names = [path.name for path in folder.iterdir()]
    assert read_pairs(out, names) == exhaustive_pairs(names)


def test_a_name_that_a_pair_file_cannot_hold_is_refused(folder, tmp_path, capsys):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("# a.png", "b.png"):
        shutil.copy(folder / "d.png", photos / name)
    out = tmp_path / "pairs.txt"
    assert main(["pairs", str(photos), "--out", str(out), "--pairs", "exhaustive"]) == 2
    assert "'# a.png' cannot be written" in capsys.readouterr().err and not out.exists()


@pytest.mark.slow
def test_a_run_tries_the_pairs_of_the_shortlist(scene, weights, tmp_path):
    out, images = tmp_path / "out", scene / "images"
    config = dataclasses.replace(jaxsfm.preset("paper"), max_size=160)
    options = jaxsfm.RunOptions(pairs="retrieval:1", retrieval="gem")
    report = jaxsfm.run_folder(images, out, config=config, options=options)
    pairs = jaxsfm.shortlist(weights, jaxsfm.open_images(images)[0], k=1, kind="gem")
    assert [tuple(row["pair"]) for row in report["pairs"]["each"]] == pairs
    assert len(pairs) == 2 and "retrieval" in report["seconds"]
