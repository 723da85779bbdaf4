"""Laws of systems whose matrix is a band, and of the layouts that have one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.core.band import band_factor, band_solve
from jaxsfm.core.bundle_layout import Free, is_formed, layout_of


def test_the_solution_is_that_of_the_whole_matrix():
    rng, (tiles, size) = rng_of(0), (5, 4)
    with jax.enable_x64(True):
        root = np.zeros((tiles, size, tiles, size))
        for k in range(tiles):
            root[k, :, k] = np.tril(rng.normal(size=(size, size))) + 3 * np.eye(size)
            if k:
                root[k, :, k - 1] = rng.normal(size=(size, size))
        root = root.reshape(tiles * size, -1)
        whole = (root @ root.T).reshape(tiles, size, tiles, size)
        at = np.arange(tiles)
        beside = np.concatenate([whole[at[:-1], :, at[1:]], rng.normal(size=(1, size, size))])
        right = rng.normal(size=(tiles, size))
        factor = band_factor(jnp.asarray(whole[at, :, at]), jnp.asarray(beside))
        found = band_solve(factor, jnp.asarray(right))
        expected = np.linalg.solve(whole.reshape(tiles * size, -1), right.ravel())
        np.testing.assert_allclose(found.ravel(), expected, rtol=1e-10)


def row(photos: int) -> tuple[np.ndarray, np.ndarray]:
    """The rows of photos in a mixed order, each of which has points in common with the next two."""
    order = rng_of(1).permutation(photos)
    point = np.repeat(np.arange(3 * photos), 3)
    photo = order[(np.arange(3 * photos)[:, None] // 3 + np.arange(3)).ravel() % photos]
    return photo, point


@pytest.mark.parametrize(("photos", "is_band"), [(200, True), (20, False)])
def test_long_rows_have_a_band_in_whatever_order_photos_come(photos, is_band):
    """The row here comes back to its start."""
    photo, point = row(photos)
    free = Free(np.ones((photos, 6), bool), np.ones(3 * photos, bool), np.zeros((1, 8), bool))
    made = layout_of(photo, point, free, camera=np.zeros(photos, int), model=np.zeros(1, int))
    assert (made.band is not None) == is_band
    if is_band:
        assert sorted(made.band.ravel()[made.band.ravel() < photos]) == list(range(photos))
        tile = np.empty(photos, int)
        tile[made.band.ravel()[:photos]] = np.arange(photos) // made.band.shape[1]
        together = photo.reshape(-1, 3)
        assert np.ptp(tile[together], axis=1).max() == 1


def test_a_camera_that_moves_or_photos_without_order_have_no_band():
    photo, point = row(2000)
    assert is_formed(photo, point, 2000, numbers=0)
    assert not is_formed(photo, point, 2000, numbers=40)
    anyhow = rng_of(2).integers(0, 2000, len(photo))
    assert not is_formed(anyhow, point, 2000, numbers=0)
