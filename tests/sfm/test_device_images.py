"""Laws of images and templates that stay on the device, and of calls that are not waited for."""

import dataclasses

import jax
import numpy as np
import pytest
from room_scene import Room, exact_model, images_of, read_of

from jaxsfm.config import Refinement
from jaxsfm.core import align
from jaxsfm.matching.pair_matching import ImageCache
from jaxsfm.sfm.refine import device_images, patch_alignment, track_alignment
from jaxsfm.sfm.refine.device_images import DeviceImages, DeviceTemplates, block_means
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits, overlapped
from jaxsfm.sfm.refine.track_alignment import AlignedBlock, align_blocks

REFINEMENT = Refinement()
LIMITS = AlignmentLimits.of(REFINEMENT)
IMAGE_BYTES = 4 * 384 * 512
"""A photo of the room, 480 x 360, padded to multiples of 128."""


def blocks_of(scene: Room, images: DeviceImages) -> list[AlignedBlock]:
    return list(align_blocks(exact_model(scene), images, REFINEMENT, LIMITS))


def assert_same(some: list[AlignedBlock], others: list[AlignedBlock]) -> None:
    for one, other in zip(some, others, strict=True):
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(x, y)


def test_views_that_show_nothing_of_a_block_change_nothing(rendered, in_blocks):
    """Their photos are not even read: there are none."""
    alone = blocks_of(rendered, images_of(rendered))
    model = exact_model(rendered)
    away = [
        dataclasses.replace(view, name="away", rotation=np.diag([-1.0, 1, -1]) @ view.rotation)
        for view in model.views[:2]
    ]
    views = [away[0], *model.views[:3], away[1], *model.views[3:]]
    place = np.asarray([1, 2, 3, 5, 6])
    tracks = model.tracks._replace(view=place[model.tracks.view])
    wider = dataclasses.replace(model, views=views, tracks=tracks)
    found = list(align_blocks(wider, images_of(rendered), REFINEMENT, LIMITS))
    assert len(found) == len(alone) == 3
    for one, other in zip(found, alone, strict=True):
        assert {*one.found.view} == {*place}
        back = np.argsort(place)
        number = np.full(len(views), -1)
        number[place] = back
        patches = one.patches._replace(reference=number[one.patches.reference])
        same = one._replace(patches=patches, found=one.found._replace(view=number[one.found.view]))
        assert_same([same], [other])


@pytest.fixture
def in_blocks(monkeypatch):
    """The points of the room in three blocks."""
    monkeypatch.setattr(track_alignment, "CELLS", 1)
    monkeypatch.setattr(track_alignment, "MIN_BLOCK", 250)


@pytest.fixture
def images_put(monkeypatch) -> list[int]:
    """The bytes of every image that is put on the device."""
    put, sizes = jax.device_put, []

    def counted(x, *args, **kwargs):
        images = [leaf for leaf in jax.tree.leaves(x) if leaf.shape[2:] == (1,)]
        sizes.extend(image.nbytes for image in images)
        return put(x, *args, **kwargs)

    monkeypatch.setattr(jax, "device_put", counted)
    return sizes


def test_every_image_goes_to_the_device_once_in_all_blocks_and_passes(
    rendered, in_blocks, images_put, monkeypatch
):
    """Nothing goes there unseen: the guard refuses transfers that are not stated."""
    patch = align.square_patch(REFINEMENT.radius)
    monkeypatch.setattr(track_alignment, "square_patch", lambda _: patch)
    images = images_of(rendered)
    with jax.transfer_guard_host_to_device("disallow"):
        for _ in range(2):
            assert len(blocks_of(rendered, images)) == 3
    assert images_put == len(rendered.views) * [IMAGE_BYTES]


def test_with_room_for_three_of_five_images_as_few_are_put_as_can_be(
    rendered, in_blocks, images_put
):
    """The fewest are those of a cache that knows what will be taken (Belady 1966)."""
    every = blocks_of(rendered, images_of(rendered))
    images_put.clear()
    images, most, taken = DeviceImages(read_of(rendered), most_bytes=3 * IMAGE_BYTES), [], []
    take = images.take

    def watched(name):
        taken.append(name)
        image = take(name)
        most.append(images.nbytes)
        return image

    images.take = watched
    assert_same(blocks_of(rendered, images), every)
    assert max(most) == 3 * IMAGE_BYTES
    fewest: list[str] = []
    best = ImageCache(fewest.append, [[name] for name in taken], 3)
    for name in taken:
        best.take(name)
    assert len(taken) >= 30
    assert len(images_put) == len(fewest) <= len(taken) / 2


def test_octaves_share_the_memory_of_an_images_reader(rendered):
    images = DeviceImages(read_of(rendered), most_bytes=IMAGE_BYTES + 4 * 256 * 256)
    whole, half = images.take("0.png"), images.octave(2).take("0.png")
    assert images.nbytes == IMAGE_BYTES + 4 * 256 * 256
    assert images.take("0.png") is whole and images.octave(2).take("0.png") is half
    assert images.octave(2).take("1.png") is not half
    assert images.take("0.png") is not whole


def test_an_image_larger_than_all_memory_is_still_there(rendered):
    images = DeviceImages(read_of(rendered), most_bytes=1)
    assert images.take("0.png").map.nbytes == images.nbytes == IMAGE_BYTES


def from_the_host(scene: Room, block: AlignedBlock) -> tuple[np.ndarray, np.ndarray]:
    """Every candidate of a block, with templates and images that come from the host for each call.

    Calls have as many rows as the block's, as programs for others may be vectorized otherwise.
    """
    patch = align.square_patch(REFINEMENT.radius)
    found, patches, size = block.found, block.patches, np.int32([360, 480])
    wide = {k: np.pad(x, ((0, 24), (0, 32)))[..., None] for k, x in scene.images.items()}
    xy, agrees = np.zeros_like(found.start), np.zeros(len(found.start), bool)
    for view in range(len(scene.views)):
        for reference in range(len(scene.views)):
            own = (found.view == view) & (patches.reference[found.point] == reference)
            for rows in np.split(np.flatnonzero(own), range(256, own.sum(), 256)):
                filled = np.resize(rows, 256) if len(rows) else np.zeros(256, int)
                one, two = (wide[f"{k}.png"] for k in (reference, view))
                centre = np.float32(patches.xy[found.point[filled]])
                start, affine = np.float32(found.start[filled]), np.float32(found.affine[filled])
                made = jax.device_get(align.make_templates(one, size, centre, patch))
                result = jax.device_get(
                    align.align(
                        two, size, made, start, affine, patch, iterations=REFINEMENT.iterations
                    )
                )
                xy[rows] = result.xy[: len(rows)]
                agrees[rows] = LIMITS.accept(result, found.start[filled])[: len(rows)]
    return xy, agrees


@pytest.mark.optimized
def test_blocks_equal_alignment_from_the_host_bit_for_bit(rendered):
    (block,) = blocks_of(rendered, images_of(rendered))
    xy, agrees = from_the_host(rendered, block)
    assert agrees.sum() > 1000
    np.testing.assert_array_equal(block.moved, xy)
    np.testing.assert_array_equal(block.agrees, agrees)


@pytest.mark.optimized
def test_the_calls_of_accelerators_give_the_cpus_keypoints_bit_for_bit(rendered, monkeypatch):
    ours = blocks_of(rendered, images_of(rendered))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert device_images.largest_chunk() == 2048
    assert_same(blocks_of(rendered, images_of(rendered)), ours)


@pytest.mark.parametrize(
    ("platform", "count", "lengths"),
    [
        ("cpu", 600, [(256, 256), (256, 256), (256, 88)]),
        ("cpu", 64, [(64, 64)]),
        ("cpu", 321, [(256, 256), (256, 65)]),
        ("gpu", 1, [(64, 1)]),
        ("gpu", 65, [(256, 65)]),
        ("gpu", 256, [(256, 256)]),
        ("gpu", 257, [(512, 257)]),
        ("gpu", 600, [(1024, 600)]),
        ("gpu", 1025, [(2048, 1025)]),
        ("gpu", 4500, [(2048, 2048), (2048, 2048), (512, 404)]),
        ("gpu", 0, []),
    ],
)
def test_calls_have_few_lengths_and_at_most_half_of_one_is_filling(
    monkeypatch, platform, count, lengths
):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    rows = np.arange(count) + 7
    parts = list(device_images.chunks(rows))
    assert [(len(filled), counted) for filled, counted in parts] == lengths
    kept = [filled[:counted] for filled, counted in parts]
    np.testing.assert_array_equal(np.concatenate([*kept, rows[:0]]), rows)
    for filled, counted in parts:
        assert (filled[counted:] == filled[0]).all()


class Unread:
    """An outcome of the device that only `jax.device_get` may look into."""

    def __init__(self, outcome):
        self.outcome = outcome

    def __array__(self, *_args, **_kwargs):
        raise AssertionError("an outcome was read on its own")


def test_an_image_is_read_once_and_after_the_next_has_been_started(
    rendered, in_blocks, monkeypatch
):
    events, get, aligned = [], jax.device_get, patch_alignment._align
    images = images_of(rendered)
    take = images.take

    def watched(name):
        events.append(name)
        return take(name)

    def unread(*args, **kwargs):
        events.append("call")
        return align.Aligned(*map(Unread, aligned(*args, **kwargs)))

    def read(x):
        events.append("read")
        return get(jax.tree.map(lambda leaf: getattr(leaf, "outcome", leaf), x))

    monkeypatch.setattr(device_images, "CHUNK", 32)  # several calls for each image
    monkeypatch.setattr(images, "take", watched)
    monkeypatch.setattr(patch_alignment, "_align", unread)
    monkeypatch.setattr(jax, "device_get", read)
    blocks = blocks_of(rendered, images)
    assert len(blocks) == 3
    assert events.count("read") == sum(len(np.unique(block.found.view)) for block in blocks)
    assert events.count("call") > 2 * events.count("read")
    waiting = 0
    for before, after in zip(events, [*events[1:], "end"], strict=True):
        waiting += (before == "call") and after != "call"  # the calls of an image are started
        waiting -= before == "read"
        assert 0 <= waiting <= 2
        assert before != "read" or waiting or after not in ("call", "read")


def test_work_is_done_when_it_is_yielded_and_the_next_is_started_before():
    events = []

    class Work:
        def __init__(self, name):
            self.name = name
            events.append(f"start {name}")

        def block_until_ready(self):
            events.append(f"done {self.name}")
            return self

    for work in overlapped(Work(name) for name in "abc"):
        events.append(f"use {work.name}")
    assert events == [
        *("start a", "start b", "done a", "use a", "start c", "done b", "use b", "done c", "use c"),
    ]
    assert list(overlapped([])) == []


def test_templates_are_taken_as_they_were_stored():
    rng = np.random.default_rng(0)

    def made(count: int) -> align.Templates:
        shapes = [(9, 1), (9, 1, 2), (2, 2), (2, 2), (2,), ()]
        floats = [rng.normal(size=(count, *shape)).astype(np.float32) for shape in shapes]
        return align.Templates(*floats, rng.random(count) < 0.5)

    store, first, second = DeviceTemplates(1000, 300), made(256), made(256)
    points = rng.permutation(1000)[:300]
    store.put(points[:256], first)
    store.put(points[256:], second)
    wanted = rng.integers(0, 300, 77)
    for x, y, found in zip(first, second, store.take(points[wanted]), strict=True):
        np.testing.assert_array_equal(np.concatenate([x, y[:44]])[wanted], found)


def small_image() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 255, (9, 14)).astype(np.float32)


def test_a_large_pixel_is_the_mean_of_those_it_covers():
    whole = small_image()
    np.testing.assert_allclose(block_means(whole, 4)[1, 2], whole[4:8, 8:12].mean(), rtol=1e-6)
    assert block_means(whole, 4).shape == (2, 3) and block_means(whole, 1) is whole


def test_unused_pixels_take_no_part_in_the_mean():
    some = small_image()
    some[4:6, 8:12] = np.nan  # half of a large pixel
    means = block_means(some, 4)
    np.testing.assert_allclose(means[1, 2], some[6:8, 8:12].mean(), rtol=1e-6)
    np.testing.assert_allclose(np.delete(means, 5), np.delete(block_means(small_image(), 4), 5))
    assert means.dtype == np.float32


def test_a_large_pixel_of_which_less_than_half_is_used_is_not_used():
    some = small_image()
    some[4:6, 8:12] = some[6, 8] = np.nan
    means = block_means(some, 4)
    assert np.isnan(means[1, 2]) and np.isfinite(np.delete(means, 5)).all()
