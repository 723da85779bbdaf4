"""Damaged COLMAP models: poses, or one sentence that names the folder; never a crash or a loop."""

import numpy as np
import pytest
from foreign_model import camera, exact_model
from fuzz_children import run_cases
from mutations import damaged, damaged_text, outcome

from jaxsfm.colmap.model_files import check_binary, read_model
from jaxsfm.colmap.poses import model_poses


def files(folder, *, text: bool):
    """A model in a folder, made once, and its files."""
    whole = folder / ("text" if text else "binary")
    if not whole.exists():
        whole.mkdir()
        model = exact_model([camera("PINHOLE"), camera("OPENCV", 2)], points=20)
        (model.write_text if text else model.write_binary)(whole)
    return sorted(whole.iterdir())


def broken(rng, folder, *, text: bool) -> str:
    own = files(folder, text=text)
    which = own[rng.integers(len(own))]
    bad = folder / "bad"
    bad.mkdir(exist_ok=True)
    for file in own:
        data = file.read_bytes()
        if file == which:
            data = damaged_text(data.decode(), rng) if text else damaged(data, rng)
        (bad / file.name).write_bytes(data)
    how, model = outcome(lambda: read_model(bad), bad)
    if how == "read":
        for pose in model_poses(model).values():
            assert np.isfinite(pose.rotation).all() and np.isfinite(pose.centre).all()
    return how


def binary_model(rng, folder) -> str:
    return broken(rng, folder, text=False)


def text_model(rng, folder) -> str:
    return broken(rng, folder, text=True)


@pytest.mark.parametrize("kind", ["binary_model", "text_model"])
def test_a_damaged_model_is_read_or_refused_by_name(tmp_path, share, least, kind):
    found = run_cases("test_fuzz_models", kind, round(300 * share), tmp_path)
    assert found["read"] > 20 * least and found["refused"] > 100 * least


def test_the_check_passes_whole_models_of_every_camera(tmp_path):
    from foreign_model import CAMERAS

    for k, name in enumerate(CAMERAS):
        (tmp_path / name).mkdir()
        model = exact_model([camera(name, k + 1)], points=20)
        model.deregister_frame(model.image(2).frame_id)
        model.write_binary(tmp_path / name)
        check_binary(tmp_path / name)
        assert len(model_poses(read_model(tmp_path / name))) == 3
