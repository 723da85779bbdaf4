"""Training learns, can be interrupted, and depends on its inputs alone."""

import dataclasses
import json

import cv2
import jax
import numpy as np
import pytest

from jaxsfm.cli.main import main
from jaxsfm.config import preset
from jaxsfm.core.scores import init_scores
from jaxsfm.errors import UserError
from jaxsfm.io.images import inspect_image
from jaxsfm.io.relocalizer import load_relocalizer, save_relocalizer
from jaxsfm.io.weights import load_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pipeline import open_images
from jaxsfm.training import relocalizer
from jaxsfm.training.objective import Objective
from jaxsfm.training.photos import Crops, split
from jaxsfm.training.relocalizer import (
    TrainOptions,
    load_checkpoint,
    save_checkpoint,
    train_relocalizer,
)

SMALL = TrainOptions(steps=6, batch=2, view=64, crop=128, hidden=4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, photos):
    folder = tmp_path_factory.mktemp("photos")
    for k, photo in enumerate(photos[:5]):
        cv2.imwrite(str(folder / f"{k}.png"), photo[:300, :300, ::-1])
    return folder


@pytest.fixture(scope="module")
def images(folder):
    return open_images(folder)[0]


@pytest.fixture
def few_measurements(monkeypatch):
    monkeypatch.setattr(relocalizer, "EVALUATION_BATCHES", 1)


@pytest.mark.slow
def test_training_lowers_the_loss_on_the_views_it_sees(weights, images, tmp_path, few_measurements):
    """All steps use the same batch."""
    options = dataclasses.replace(SMALL, steps=60, hidden=8, learning_rate=0.05)
    warp = relocalizer.warped_examples(
        weights.params,
        jax.random.key(0),
        Crops(images, side=options.crop, seed=0).draw(0, 2),
        preprocessing=weights.preprocessing,
        size=options.view,
    )
    state, losses = relocalizer.start_state(options), []
    for _ in range(60):
        state, figures = relocalizer.train_step(state, warp, None, options=options)
        losses.append(float(figures["loss"]))
    assert losses[-1] < 0.85 * losses[0]


@pytest.mark.parametrize(("at", "reached"), [("train_step", 3), ("mean_shares", 2)])
@pytest.mark.slow
def test_an_interrupted_training_ends_with_the_same_parameters(
    weights, images, tmp_path, monkeypatch, few_measurements, at, reached
):
    """Interrupts the fourth step, or the fourth measurement (that of the third step)."""
    whole, parts = tmp_path / "whole.safetensors", tmp_path / "parts.safetensors"
    train_relocalizer(weights, images, whole, options=SMALL)
    real, done = getattr(relocalizer, at), []

    def step(*args, **kwargs):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(1)
        return real(*args, **kwargs)

    monkeypatch.setattr(relocalizer, at, step)
    with pytest.raises(KeyboardInterrupt):
        train_relocalizer(weights, images, parts, options=SMALL)
    assert not parts.exists()
    monkeypatch.setattr(relocalizer, at, real)
    told = []
    train_relocalizer(weights, images, parts, options=SMALL, tell=told.append)
    assert f"going on from step {reached}" in told[0]
    assert parts.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob("*.checkpoint"))


def test_another_training_does_not_go_on_from_a_state(weights, images, tmp_path, few_measurements):
    out = tmp_path / "a.safetensors"
    kept = tmp_path / "a.safetensors.checkpoint"
    other = dataclasses.replace(SMALL, seed=1)
    save_checkpoint(kept, relocalizer.start_state(other), {"of": {}, "history": []})
    with pytest.raises(UserError, match="another training"):
        train_relocalizer(weights, images, out, options=SMALL)
    kept.write_bytes(b"nonsense")
    with pytest.raises(UserError, match="not a readable checkpoint"):
        train_relocalizer(weights, images, out, options=SMALL)


def test_checkpoints_of_another_shape_are_refused(tmp_path):
    path = tmp_path / "c"
    save_checkpoint(path, {"a": np.zeros(3), "b": np.ones((2, 2))}, {"of": 1})
    found, about = load_checkpoint(path, {"a": np.zeros(3), "b": np.zeros((2, 2))})
    assert about == {"of": 1} and np.array_equal(found["b"], np.ones((2, 2)))
    with pytest.raises(UserError, match="another training"):
        load_checkpoint(path, {"a": np.zeros(3), "b": np.zeros((3, 2))})


def test_photos_are_split_by_content_and_crops_depend_on_the_step_alone(images):
    train, held_out = split(images)
    again = split([*images[::-1], images[0]])
    assert [i.sha256 for i in again[0]] == [i.sha256 for i in train]
    assert len(train) + len(held_out) == len(images) and held_out
    first, second = (Crops(train, side=96, seed=4) for _ in range(2))
    first.draw(0, 2)
    np.testing.assert_array_equal(first.draw(5, 3), second.draw(5, 3))
    assert not np.array_equal(first.draw(5, 3), first.draw(6, 3))
    with pytest.raises(UserError, match="at least 2 different photos"):
        split(images[:1] * 3)


def test_photos_smaller_than_a_crop_are_mirrored(tmp_path, photos):
    cv2.imwrite(str(tmp_path / "small.png"), photos[0][:60, :80])
    crops = Crops([inspect_image(tmp_path / "small.png")], side=200, seed=0).draw(0, 1)
    assert crops.shape == (1, 200, 200, 3) and crops.std() > 10


@pytest.mark.slow
def test_untrained_scores_give_the_paper_s_keypoints(folder, images, tmp_path):
    path = tmp_path / "untrained.safetensors"
    save_relocalizer(path, jax.device_get(init_scores(jax.random.key(0))), {})
    weights = load_weights(relocalizer=path)
    norm, learned = (
        image_features(
            weights, images[0], config=dataclasses.replace(preset("paper"), keypoints=keypoints)
        ).dense
        for keypoints in ("relocalized", "learned")
    )
    np.testing.assert_array_equal(norm.keypoints, learned.keypoints)
    np.testing.assert_array_equal(norm.coarse[0], learned.coarse[0])


@pytest.mark.parametrize(
    ("field", "value"),
    [("steps", 0), ("view", 60), ("crop", 10), ("learning_rate", 2.0), ("seed", -1), ("batch", 0)],
)
def test_wrong_options_are_refused_by_name(field, value):
    with pytest.raises(ValueError, match=field):
        dataclasses.replace(SMALL, **{field: value})


@pytest.mark.parametrize("field", ["temperature", "peakiness"])
def test_wrong_objectives_are_refused_by_name(field):
    with pytest.raises(ValueError, match=field):
        Objective(**{field: -1.0})


# -- command line -------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_trained_file_is_used_by_reconstruct_and_match(
    folder, scene, tmp_path, capsys, few_measurements
):
    out = tmp_path / "learned.safetensors"
    command = ["train", "relocalizer", "--images", str(folder), "--out", str(out)]
    assert main([*command, "--steps", "1", "--batch", "1", "--hidden", "2"]) == 0
    text = capsys.readouterr().out
    assert "within 1 px" in text and "step    1" in text
    about = load_relocalizer(out).about
    assert about["options"]["steps"] == 1 and about["photos"]["trained_on"] == 4
    assert about["walked"] == load_weights().walked
    images = sorted((scene / "images").iterdir())
    run = tmp_path / "run"
    reconstruct = ["reconstruct", str(scene / "images"), "--out", str(run), "--refine", "0"]
    assert main([*reconstruct, "--relocalizer", str(out)]) == 0
    identity = json.loads((run / "run.json").read_text())
    assert identity["relocalizer"] == load_relocalizer(out).sha256
    # Other keypoints make another run; the log says so, and the rest is used again.
    assert main([*reconstruct, "--keypoints", "relocalized"]) == 0
    said = capsys.readouterr().err
    assert "the last run there differs" in said and "relocalizer: " in said
    assert json.loads((run / "run.json").read_text())["relocalizer"] is None
    match = ["match", str(images[0]), str(images[1]), "--out", str(tmp_path / "m.npz")]
    assert main([*match, "--relocalizer", str(out)]) == 0


def test_misuse_gets_one_sentence(folder, scene, tmp_path, capsys):
    out, train = tmp_path / "a.safetensors", ["train", "relocalizer", "--images", str(folder)]
    images = str(scene / "images")
    cases = [
        ([*train, "--out", str(tmp_path / "a.bin")], "must end in .safetensors"),
        ([*train, "--out", str(out), "--steps", "0"], "--steps must be at least 1"),
        ([*train, "--out", str(out), "--temperature", "0"], "--temperature must be positive"),
        ([*train, "--out", str(out), "--reference", images], "--intrinsics belong together"),
        (
            ["train", "relocalizer", "--images", str(tmp_path), "--out", str(out)],
            "no image",
        ),
        (
            ["reconstruct", images, "--out", str(tmp_path / "o"), "--relocalizer", "none.bin"],
            "none.bin: cannot read the relocalizer",
        ),
        (
            [
                *("reconstruct", images, "--out", str(tmp_path / "o"), "--keypoints", "grid"),
                *("--relocalizer", "none.bin"),
            ],
            "needs learned keypoints",
        ),
    ]
    for arguments, words in cases:
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert words in error and "Traceback" not in error and len(error.splitlines()) == 1


def test_training_on_weights_that_are_not_there_names_them(folder, tmp_path, capsys):
    out, nowhere = str(tmp_path / "a.safetensors"), str(tmp_path / "nowhere.safetensors")
    command = ["train", "relocalizer", "--images", str(folder), "--out", out]
    assert main([*command, "--weights", nowhere]) == 2
    assert f"{nowhere}: cannot read the weights" in capsys.readouterr().err
