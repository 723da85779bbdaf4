"""Laws of how many views a point is looked for in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room_scene import exact_model, images_of
from strategies import rng_of, seeds

from jaxsfm.config import Refinement
from jaxsfm.sfm.check import agreement
from jaxsfm.sfm.refine import fixed_structure
from jaxsfm.sfm.refine.candidates import within_most_views
from jaxsfm.sfm.refine.fixed_structure import FixedStructure
from jaxsfm.sfm.refine.patch_alignment import AlignmentLimits
from jaxsfm.sfm.refine.track_alignment import align_blocks


def drawn(seed: int, points: int, views: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Candidates in the order of views, some of them observations of tracks."""
    rng = rng_of(seed)
    point, view = np.nonzero(rng.random((points, views)) < 0.7)
    order = np.argsort(view, kind="stable")
    return point[order], view[order], rng.random(len(point)) < 0.3


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(2, 12))
def test_tracks_stay_and_a_point_gets_new_views_until_it_has_enough(seed, most):
    point, view, tracked = drawn(seed, 20, 15)
    kept = within_most_views(point, view, tracked, most)
    assert kept[tracked].all()
    for k in range(20):
        own, of_tracks = point == k, tracked & (point == k)
        room = max(0, most - 1 - of_tracks.sum())
        assert (kept & own & ~tracked).sum() == min(room, (own & ~tracked).sum())


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_which_views_a_point_gets_does_not_depend_on_their_order(seed):
    point, view, tracked = drawn(seed, 20, 15)
    kept = within_most_views(point, view, tracked, 5)
    order = rng_of(seed + 1).permutation(len(point))
    again = within_most_views(point[order], view[order], tracked[order], 5)
    np.testing.assert_array_equal(kept[order], again)


def test_all_views_are_equally_likely():
    """Of 4000 points that 20 views could see, each view gets a fifth."""
    point, view = (each.ravel() for each in np.mgrid[:4000, :20])
    kept = within_most_views(point, view, np.zeros(len(point), bool), 5)
    shares = np.bincount(view[kept], minlength=20) / 4000
    np.testing.assert_allclose(shares, 0.2, atol=0.03)
    assert len({tuple(row) for row in view[kept].reshape(4000, 4)}) > 1000


@pytest.fixture(scope="module")
def aligned(rendered):
    """With a setting, in how many views each point of the room is looked for. The model has one
    observation of each point."""

    def of(refinement: Refinement) -> np.ndarray:
        model = exact_model(rendered)
        first = np.unique(model.tracks.point, return_index=True)[1]
        alone = np.isin(np.arange(len(model.tracks.point)), first)
        model = model.with_tracks(model.tracks.select(alone))
        limits = AlignmentLimits.of(refinement)
        blocks = align_blocks(model, images_of(rendered), refinement, limits)
        return np.concatenate([np.bincount(b.found.point, minlength=len(b.rows)) for b in blocks])

    return of


def test_the_refinement_looks_for_a_point_in_so_many_views(aligned):
    every, few = aligned(Refinement(most_views=0)), aligned(Refinement(most_views=3))
    assert every.max() > 2 == few.max()
    np.testing.assert_array_equal(few, np.minimum(every, 2))
    np.testing.assert_array_equal(aligned(Refinement(most_views=1).in_all_views()), every)


@pytest.mark.parametrize("module", [agreement, fixed_structure])
def test_the_check_and_the_placing_look_in_all_views(module, monkeypatch, rendered):
    """What a photo contradicts, and where a photo stands, must not depend on a draw."""
    asked = []

    def align_blocks(model, images, refinement, limits, **_):
        asked.append(refinement.most_views)
        return iter(())

    monkeypatch.setattr(module, "align_blocks", align_blocks)
    model, images = exact_model(rendered), images_of(rendered)
    if module is agreement:
        agreement._tested(model, images, Refinement(), None, None)
    else:
        FixedStructure(model, images, Refinement()).shown_from([rendered.views[0]], 1)
    assert asked == [0]
