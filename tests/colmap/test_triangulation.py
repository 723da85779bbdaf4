"""Laws of the points that a model gets from all verified matches."""

import pycolmap
import pytest

from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.triangulation import with_all_points


@pytest.fixture
def synthetic(tmp_path):
    """A model of five photos, and the database that its matches are in."""
    path = tmp_path / "database.db"
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, 60
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(path) as database:
        return pycolmap.synthesize_dataset(options, database), path


def few_points(model: pycolmap.Reconstruction, count: int) -> pycolmap.Reconstruction:
    """The model with some of its points."""
    few = pycolmap.Reconstruction(model)
    for point in sorted(few.point3D_ids())[count:]:
        few.delete_point3D(point)
    return few


def test_a_model_gets_the_points_of_all_matches_and_is_not_changed_itself(synthetic):
    model, path = synthetic
    draft = few_points(model, 20)
    whole = with_all_points(draft, path, MapOptions())
    assert whole.num_points3D() == 60 and draft.num_points3D() == 20


def test_a_model_without_any_match_keeps_its_points(synthetic):
    model, path = synthetic
    draft = few_points(model, 20)
    with pycolmap.Database.open(path) as database:
        database.clear_two_view_geometries()
    kept = with_all_points(draft, path, MapOptions())
    assert kept is not draft and kept.num_points3D() == 20
