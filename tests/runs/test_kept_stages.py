"""What is kept of a run is used again as far as nothing it depends on has changed."""

import json
import shutil

import pytest

from jaxsfm.cli.main import main
from jaxsfm.colmap import model_files
from jaxsfm.io.store import Store
from jaxsfm.sfm import mapped_stage, refined_stage


@pytest.fixture
def counted(monkeypatch) -> dict[str, int]:
    """How often each stage was made."""
    counts = dict.fromkeys(("extract", "match", "verify", "map", "refine"), 0)

    def count(owner, name: str, stage: str, of=lambda *_: 1) -> None:
        original = getattr(owner, name)

        def wrapped(*args, **kwargs):
            counts[stage] += of(*args)
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, wrapped)

    count(Store, "save_features", "extract")
    count(Store, "save_matches", "match")
    count(mapped_stage, "verify", "verify")
    count(mapped_stage.Mapper, "map", "map")
    count(refined_stage, "refine_models", "refine")
    return counts


@pytest.mark.slow
def test_a_change_redoes_exactly_what_depends_on_it(scene, tmp_path, counted, capsys):
    photos, out = tmp_path / "images", tmp_path / "out"
    shutil.copytree(scene / "images", photos)
    base = ["reconstruct", str(photos), "--out", str(out), "--preset", "paper", "--threads", "1"]
    first, second, third = sorted(photos.iterdir())
    photo = third.read_bytes()

    def added() -> None:
        (photos / "more.png").write_bytes(photo + b"\n")

    steps = [  # what is changed; extracted, matched, verified, mapped, refined
        ([], None, (3, 3, 1, 1, 1)),
        ([], None, (0, 0, 0, 0, 0)),
        # Models that are refined are mapped from a share of the matches, others from all.
        (["--refine", "1"], None, (0, 0, 0, 1, 1)),
        (["--refine", "2"], None, (0, 0, 0, 0, 1)),
        (["--mapper", "global"], None, (0, 0, 0, 1, 1)),
        (["--intrinsics", str(scene / "K.txt")], None, (0, 0, 1, 1, 1)),
        (["--best-pairs", "1"], None, (0, 0, 1, 1, 1)),
        (["--seed", "1", "--keep-features"], None, (3, 3, 1, 1, 1)),
        (["--seed", "2"], None, (0, 3, 1, 1, 1)),
        ([], None, (0, 0, 1, 1, 1)),
        ([], third.unlink, (0, 0, 1, 1, 1)),
        ([], lambda: third.write_bytes(photo), (0, 0, 1, 1, 1)),
        ([], added, (4, 3, 1, 1, 1)),
    ]
    for options, change, expected in steps:
        if change is not None:
            change()
        counted.update(dict.fromkeys(counted, 0))
        # Two photos, one of them at night, make no model; the stages are gone through all the same.
        assert main([*base, *options]) == (len(list(photos.iterdir())) < 3)
        assert tuple(counted.values()) == expected, (options, change)
    assert "1 images, first 'more.png'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_kept_stage_gives_what_it_would_give_if_it_were_made_again(scene, tmp_path):
    base = ["reconstruct", str(scene / "images"), "--preset", "paper", "--threads", "1"]
    for out, refine in (("a", "0"), ("a", "1"), ("b", "1")):
        assert main([*base, "--refine", refine, "--out", str(tmp_path / out)]) == 0
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        one, two = (tmp_path / out / "sparse" / "0" / name for out in ("a", "b"))
        assert one.read_bytes() == two.read_bytes()


def test_cameras_keep_what_is_known_of_their_focal_length(tmp_path):
    import pycolmap

    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_frames_per_rig=3))
    database = tmp_path / "database.db"
    with pycolmap.Database.open(database) as db:
        for camera_id, camera in sorted(model.cameras.items()):
            camera.has_prior_focal_length = camera_id % 2 == 1
            assert db.write_camera(camera) == camera_id
    model_files.write_models([model], tmp_path / "sparse")
    (back,) = model_files.read_models(tmp_path / "sparse", database)
    known = {k: c.has_prior_focal_length for k, c in back.cameras.items()}
    assert known == {k: k % 2 == 1 for k in model.cameras} and True in known.values()


@pytest.mark.slow
def test_a_refinement_that_a_lost_photo_prevented_is_tried_again(scene, tmp_path, monkeypatch):
    from jaxsfm.io.images import ImageError

    out = tmp_path / "out"
    base = ["reconstruct", str(scene / "images"), "--preset", "paper", "--refine", "1"]

    def gone(*_, **__):
        raise ImageError("gone")

    with monkeypatch.context() as patch:
        patch.setattr("jaxsfm.sfm.refined_models.refine_model", gone)
        assert main([*base, "--out", str(out)]) == 0
    made = []
    original = refined_stage.refine_models
    again = lambda *a, **k: made.append(1) or original(*a, **k)  # noqa: E731
    monkeypatch.setattr(refined_stage, "refine_models", again)
    assert main([*base, "--out", str(out)]) == 0 and made == [1]
    assert main([*base, "--out", str(out)]) == 0 and made == [1]


@pytest.mark.slow
def test_a_photo_that_was_away_for_a_moment_is_back_in_the_next_run(scene, tmp_path, monkeypatch):
    from jaxsfm.io import images

    base = ["reconstruct", str(scene / "images"), "--preset", "paper", "--refine", "0"]
    command = [*base, "--out", str(tmp_path / "out")]
    original = images.image_bytes

    def away(image):
        if image.name == "view0.png":
            raise images.ImageError("view0.png: cannot be read (Host is down)")
        return original(image)

    with monkeypatch.context() as patch:
        patch.setattr(images, "image_bytes", away)
        main(command)
    assert main(command) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["images"]["usable"] == 3 and report["images"]["skipped"] == {}


@pytest.mark.slow
def test_a_check_that_a_lost_photo_prevented_is_made_in_the_next_run(scene, tmp_path, monkeypatch):
    """Otherwise the model would stay without a verdict for good."""
    from jaxsfm.io.images import ImageError
    from jaxsfm.sfm import checker

    command = ["reconstruct", str(scene / "images"), "--refine", "0", "--threads", "1"]
    command += ["--intrinsics", str(scene / "K.txt"), "--out", str(tmp_path / "out")]

    def gone(*_, **__):
        raise ImageError("gone")

    def checks() -> list:
        return json.loads((tmp_path / "out" / "report.json").read_text())["checks"]

    with monkeypatch.context() as patch:
        patch.setattr(checker, "check_model", gone)
        assert main(command) == 0
    assert checks() == [None]
    assert main(command) == 0
    assert checks() != [None]
    made, original = [], checker.check_model
    monkeypatch.setattr(checker, "check_model", lambda *a: made.append(1) or original(*a))
    assert main(command) == 0 and made == []
