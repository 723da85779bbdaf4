"""Laws of localization in a finished run, on a rendered room whose cameras are known."""

import dataclasses
import hashlib
import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from kept_runs import change_report, with_two_models

from jaxsfm.bench.synthetic import camera_matrix, look_at, render, room
from jaxsfm.cli.main import main
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.model_files import read_model
from jaxsfm.config import preset
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageError, inspect_image
from jaxsfm.io.store import Store
from jaxsfm.matching.engines import LocalEngine
from jaxsfm.matching.execution import Execution
from jaxsfm.options import EngineChoice
from jaxsfm.report.finished_run import read_run
from jaxsfm.runs import localize as localize_module
from jaxsfm.runs.localize import cameras_of_query, localize_photos
from jaxsfm.runs.localize_report import LocalizationReport, LocalizedPhoto, localize_lines
from jaxsfm.runs.run_options import LocalizeOptions
from jaxsfm.runs.working_model import (
    WorkingModel,
    camera_prior,
    camera_priors,
    read_working_model,
    similar_photos,
)
from jaxsfm.sfm.register.locate_view import Localization

SIZE, WIDE = (320, 240), (368, 248)
"""Of one padded size: nothing is compiled twice."""
POSE = look_at(np.asarray([-0.6, -0.5, 0.6]), np.asarray([-0.1, 0.1, 5.2]))
"""Of the new photos: between the run's views."""
POSITION, ROTATION_DEG = 0.03, 0.5
"""Errors of a good pose; a working pixel is 0.015 units at the room's distance. Three small views
say little of their rotation: with five seeds, photos are 0.0012 to 0.0031 units and 0.10 to 0.45
deg off."""


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def write(path: Path, rgb: np.ndarray) -> Path:
    cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return path


class RecordingEngine:
    """Computes in this process, and records how many items each call has."""

    def __init__(self, *, starts_workers: bool = False) -> None:
        self.starts_workers, self.calls = starts_workers, []

    def extract_images(self, weights, images, **options):
        self.calls.append(("extract", len(images)))
        return LocalEngine.extract_images(weights, images, **options)

    def match_pairs(self, load, capacities, pairs, **options):
        self.calls.append(("match", len(pairs)))
        return LocalEngine.match_pairs(load, capacities, pairs, **options)


def localize(photos: list[Path], run: Path, **changes) -> dict:
    """What the command writes."""
    return localize_photos(photos, run, **changes).to_json()


@pytest.fixture(scope="module")
def photos(scene, tmp_path_factory) -> Path:
    """Photos to localize, in a folder, and reference poses that know the new ones too."""
    folder = tmp_path_factory.mktemp("localize")
    (folder / "photos").mkdir()
    write(folder / "photos" / "new.png", render(room(), POSE, SIZE))
    write(folder / "photos" / "wide.png", render(room(), POSE, WIDE))
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    write(folder / "photos" / "elsewhere.png", np.kron(noise, np.ones((4, 4, 1), np.uint8)))
    (folder / "photos" / "broken.png").write_bytes(b"not an image")
    shutil.copy(scene / "images" / "view0.png", folder / "photos" / "again.png")
    shutil.copytree(scene / "reference", folder / "reference")
    rows = [*camera_matrix(SIZE), np.zeros(3), *POSE.rotation.T, POSE.centre, np.asarray(SIZE)]
    text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in rows)
    for name in ("new.png", "wide.png"):
        (folder / "reference" / f"{name}.camera").write_text(text + "\n")
    return folder


@pytest.fixture(scope="module")
def localized(photos, plain) -> dict[str, dict]:
    """Rows of all photos in one call, by file name."""
    before = contents(plain[0])
    options = LocalizeOptions(reference=photos / "reference")
    with pytest.MonkeyPatch.context() as patch:
        # Further passes compile programs for minutes; test_localize_further.py says when they
        # follow.
        patch.setattr(localize_module, "match_further", lambda *_: {})
        result = localize([photos / "photos"], plain[0], options=options)
    assert contents(plain[0]) == before  # the run stays as it is
    return {Path(row["photo"]).name: row for row in result["photos"]}


def test_a_new_photo_is_localized_and_knows_about_how_well(localized):
    row = localized["new.png"]
    assert row["status"] == "localized" and row["confidence"]["trusted"]
    assert row["error"]["position"] < POSITION / 5 and row["error"]["rotation_deg"] < ROTATION_DEG
    assert row["camera"]["source"] == "run" and row["in_run"] is None
    assert len(row["shortlist"]) == 3 and row["inliers"] > 100 and row["agreed"] > 100
    expected = row["confidence"]
    assert 0 < expected["centre_error"] < POSITION
    assert 0 < expected["rotation_error_deg"] < ROTATION_DEG


def test_a_pose_is_colmaps(localized):
    """cam_from_world takes the centre to the origin."""
    pose = localized["new.png"]["cam_from_world"]
    w, *v = pose["rotation_wxyz"]
    x = np.asarray(localized["new.png"]["centre"])
    turned = x + 2 * np.cross(v, np.cross(v, x) + w * x)
    np.testing.assert_allclose(turned + pose["translation"], 0, atol=1e-9)


def test_a_photo_of_another_size_has_its_focal_length_estimated(localized):
    row = localized["wide.png"]
    assert row["status"] == "localized" and row["camera"]["source"] == "guess"
    assert row["camera"]["params"][0] == pytest.approx(WIDE[0], rel=0.03)
    assert row["error"]["position"] < 5 * POSITION


def test_a_photo_of_the_run_is_told_and_finds_its_pose_without_itself(localized, plain, scene):
    row = localized["again.png"]
    assert row["in_run"] == "view0.png" and "view0.png" not in row["shortlist"]
    assert row["status"] == "localized"


def test_a_photo_of_elsewhere_is_lost_for_a_reason(localized):
    row = localized["elsewhere.png"]
    assert row["status"] == "lost" and any(char.isdigit() for char in row["why"])
    assert "cam_from_world" not in row and row["confidence"]["centre_error"] is None


def test_one_bad_file_keeps_no_other_from_its_pose(localized):
    assert localized["broken.png"]["status"] == "unusable"
    assert "not a readable image" in localized["broken.png"]["why"]


@pytest.mark.slow
def test_a_photo_alone_and_under_another_name_has_the_same_pose(localized, plain, photos, tmp_path):
    other = shutil.copy(photos / "photos" / "new.png", tmp_path / "other.png")
    alone = localize([Path(other)], plain[0], options=LocalizeOptions())["photos"][0]
    for key in localized["new.png"].keys() - {"photo", "error"}:
        assert alone[key] == localized["new.png"][key], key


@pytest.mark.slow
def test_kept_features_spare_the_next_call_and_change_no_pose(
    localized, plain, photos, tmp_path, monkeypatch
):
    run, computed = Path(shutil.copytree(plain[0], tmp_path / "run")), []
    extract_images = LocalEngine.extract_images

    def counted(weights, images, **kwargs):
        computed.append(len(images))
        return extract_images(weights, images, **kwargs)

    monkeypatch.setattr(LocalEngine, "extract_images", staticmethod(counted))
    for keep in (True, False):  # the second call neither computes nor deletes
        options = LocalizeOptions(keep_features=keep)
        row = localize([photos / "photos" / "new.png"], run, options=options)["photos"][0]
        assert row["cam_from_world"] == localized["new.png"]["cam_from_world"]
        assert len(list(run.glob("features/*/*.safetensors"))) == 3
    assert computed == [3, 1, 1]  # the run's photos once, the new one in each call


@pytest.mark.slow
def test_localize_asks_the_engine_that_was_chosen(localized, plain, photos, monkeypatch):
    """Even one that takes all photos in one call gives every photo what it has alone."""
    choices, engine = [], RecordingEngine(starts_workers=True)
    monkeypatch.setattr(localize_module, "chosen_engine", lambda c: choices.append(c) or engine)
    choice = EngineChoice(engine="ray", workers=3)
    options = LocalizeOptions(engine=choice, reference=photos / "reference")
    result = localize([photos / "photos"], plain[0], options=options)
    assert choices == [choice]
    # The run has the features of the photo that it has.
    assert engine.calls == [("extract", 3), ("extract", 3), ("match", 11)]
    for row in result["photos"]:
        assert row | {"photo": ""} == localized[Path(row["photo"]).name] | {"photo": ""}


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_localize_on_ray_gives_what_this_process_gives(localized, plain, photos, tmp_path):
    out, new = tmp_path / "poses.json", photos / "photos" / "new.png"
    wide = photos / "photos" / "wide.png"
    ray = ["--engine", "ray", "--workers", "2", "--ray-address", "local"]
    command = ["localize", str(new), str(wide), "--model", str(plain[0]), "--out", str(out)]
    assert main([*command, *ray]) == 0
    for row in json.loads(out.read_text())["photos"]:
        wanted = localized[Path(row["photo"]).name]
        for key in wanted.keys() - {"photo", "error"}:
            assert row[key] == wanted[key], key


@pytest.mark.slow
def test_the_shortlist_decides_what_a_photo_is_matched_with(plain, photos):
    result = localize(
        [photos / "photos" / "new.png"],
        plain[0],
        options=LocalizeOptions(),
        shortlist=lambda image, names: [n for n in names if n == "view2.png"],
    )
    assert result["photos"][0]["shortlist"] == ["view2.png"]
    assert result["photos"][0]["status"] in ("localized", "doubtful")


@pytest.mark.slow
def test_the_most_similar_photos_are_shortlisted_and_described_once(
    plain, photos, weights, tmp_path, monkeypatch
):
    run = read_run(Path(shutil.copytree(plain[0], tmp_path / "run")))
    image = inspect_image(photos / "photos" / "again.png", name="photo")
    names = ["view0.png", "view1_night.png", "view2.png"]

    def shortlist(k: int, names: list[str]) -> list[str]:
        return list(similar_photos(run, weights, k, {"photo": image}, Execution())(image, names))

    assert shortlist(1, names) == ["view0.png"]  # it is that photo
    two = shortlist(2, names)
    assert two == shortlist(2, names[::-1]) and two[0] == "view0.png"
    assert shortlist(3, names) == names
    assert (run.store.path / "descriptors").is_dir()
    monkeypatch.setattr(run.photos, "file", None)  # nobody opens them again
    assert shortlist(1, names) == ["view0.png"]
    with pytest.raises(UserError, match="--shortlist"):
        shortlist(0, names)
    cut = tmp_path / "cut.png"
    cut.write_bytes((photos / "photos" / "new.png").read_bytes()[:2000])
    bad = inspect_image(cut, name="bad")
    choose = similar_photos(run, weights, 1, {"photo": image, "bad": bad}, Execution())
    assert choose(image, [*names, "bad"]) == ["view0.png"]
    with pytest.raises(ImageError):
        choose(bad, names)


@pytest.mark.slow
def test_a_run_that_cannot_be_written_still_finds_the_most_similar_photos(
    plain, photos, weights, tmp_path, monkeypatch
):
    run = read_run(Path(shutil.copytree(plain[0], tmp_path / "run")))
    home, save = run.store.path, Store.save_descriptor

    def refused(self, *args):
        if self.path == home:
            raise UserError("cannot be written")
        save(self, *args)

    monkeypatch.setattr(Store, "save_descriptor", refused)
    image = inspect_image(photos / "photos" / "again.png", name="photo")
    choose = similar_photos(run, weights, 1, {"photo": image}, Execution())
    assert choose(image, ["view0.png", "view2.png"]) == ["view0.png"]
    assert not list(home.glob("descriptors/*/*"))


@pytest.mark.slow
def test_features_that_cannot_be_kept_are_one_sentence(plain, photos, tmp_path, capsys):
    run = Path(shutil.copytree(plain[0], tmp_path / "run"))
    (run / "features").write_text("in the way")
    command = ["localize", str(photos / "photos" / "new.png"), "--model", str(run)]
    assert main([*command, "--keep-features"]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error and f"{run}" in error


def test_a_photo_has_the_camera_that_several_photos_of_its_size_have(plain, photos):
    model = read_working_model(plain[0] / "sparse" / "0", preset("default"))
    new = inspect_image(photos / "photos" / "new.png", name="photo")
    odd_one, wide = (
        pycolmap.Camera(
            model="SIMPLE_PINHOLE", width=size[0], height=size[1], params=[300, 160, 120]
        )
        for size in (SIZE, WIDE)
    )
    odd_one.camera_id, wide.camera_id = 7, 8
    first = model.views[0]

    def chosen(*more):
        views = [*model.views, *(dataclasses.replace(first, camera=camera) for camera in more)]
        found = camera_prior(new, views, None)
        return found.source, found.camera.camera_id

    shared = first.camera.camera_id
    assert chosen() == chosen(odd_one) == chosen(odd_one, wide, wide) == ("run", shared)
    assert chosen(odd_one, odd_one)[0] == "guess"  # nobody can tell which
    assert camera_prior(new, model.views[:1], None).source == "guess"  # nobody else's
    # EXIF decides between cameras of one size, and a photo of another one gets none of them.
    named = dataclasses.replace(new, taken_with="phone")
    assert camera_prior(named, model.views, None).source == "guess"
    assert camera_prior(named, model.views, None, lambda _: "phone").source == "run"


@pytest.mark.slow
def test_a_photo_is_localized_in_the_model_of_which_it_shows_most(
    plain, photos, localized, tmp_path
):
    """Its camera is the one of that model. The first model has a third of the points."""
    run = with_two_models(Path(shutil.copytree(plain[0], tmp_path / "run")))
    first = read_model(run / "sparse" / "0")
    for camera in first.cameras.values():
        camera.params = 1.01 * camera.params
    first.write(run / "sparse" / "0")
    result = localize_photos([photos / "photos" / "new.png"], run, options=LocalizeOptions())
    (row,) = result.to_json()["photos"]
    assert row["in_model"] == 1 and localized["new.png"]["in_model"] == 0
    for name in ("centre", "camera", "agreed", "shortlist"):
        assert row[name] == localized["new.png"][name]
    assert "in sparse/1, centre" in "\n".join(localize_lines(result))


def test_a_photo_starts_with_the_camera_as_each_model_has_refined_it(plain, photos):
    """Whether a camera of the run is known is asked of all models together."""
    model = read_working_model(plain[0] / "sparse" / "0", preset("default"))
    new = inspect_image(photos / "photos" / "new.png", name="photo")

    def refined(names: list[str], focal: float) -> WorkingModel:
        views = [view for view in model.views if view.name in names]
        camera = pycolmap.Camera(views[0].camera.todict())
        camera.params = [focal, *camera.params[1:]]
        views = [dataclasses.replace(view, camera=camera) for view in views]
        return model._replace(model=model.model.with_views(views))

    names = [view.name for view in model.views]
    both = [refined(names, 310.0), refined(names[:1], 320.0)]  # its photo is in both
    for models in (both, both[::-1]):
        found = camera_priors(new, models, None)
        assert [prior.source for prior in found] == ["run", "run"]
        assert [prior.camera.params[0] for prior in found] == [
            each.views[0].camera.params[0] for each in models
        ]
        told = camera_priors(new, models, None, lambda name: "phone" if name == names[0] else "")
        assert len({prior.source for prior in told}) == 1
    alone = [refined(names[:1], 310.0), refined(names[1:2], 320.0)]
    assert [prior.source for prior in camera_priors(new, alone, None)] == ["run", "run"]
    assert [prior.source for prior in camera_priors(new, alone[:1], None)] == ["guess"]


@pytest.mark.slow
def test_an_empty_folder_keeps_no_photo_from_its_pose(plain, photos, tmp_path):
    (tmp_path / "empty").mkdir()
    new = photos / "photos" / "new.png"
    found = localize([tmp_path / "empty", new], plain[0], options=LocalizeOptions())["photos"]
    status = {row["photo"]: row["status"] for row in found}
    assert status == {str(tmp_path / "empty"): "unusable", str(new): "localized"}


# -- the command ----------------------------------------------------------------------------------


def says(capsys, *args) -> str:
    """What a wrong call says: one sentence, status 2."""
    assert main(["localize", *map(str, args)]) == 2
    text = capsys.readouterr().err
    assert text.startswith("jaxsfm: ") and text.count("\n") == 1, text
    return text


@pytest.mark.slow
def test_the_command_writes_poses_and_tells_them(plain, photos, tmp_path, capsys):
    new, out = photos / "photos" / "new.png", tmp_path / "poses.json"
    assert main(["localize", str(new), "--model", str(plain[0]), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "localized" in text and "expected error" in text and "1 localized of 1" in text
    row = json.loads(out.read_text())["photos"][0]
    assert row["photo"] == str(new) and row["cam_from_world"]


def test_nothing_localized_ends_with_1(plain, photos, capsys, monkeypatch):
    numbers = dict.fromkeys(("on_surface", "inliers", "candidates", "agreed"), 0)
    errors = dict.fromkeys(("octave_px", "error_px", "uncertainty_px"))
    errors |= dict.fromkeys(("centre_error", "rotation_error_deg"))
    found = Localization(view=None, trusted=False, why="no plane", **numbers, **errors)
    row = LocalizedPhoto(
        photo="a.png", in_run=None, shortlist=[], matches=0, source="run", model=0, found=found
    )
    result = LocalizationReport(version="1", model=str(plain[0]), photos=[row])
    monkeypatch.setattr(localize_module, "localize_photos", lambda *args, **kwargs: result)
    lost = photos / "photos" / "elsewhere.png"
    assert main(["localize", str(lost), "--model", str(plain[0])]) == 1
    captured = capsys.readouterr()
    assert "no photo could be localized" in captured.err and "1 lost of 1" in captured.out


def test_the_camera_of_a_query_is_the_one_of_all_photos_or_that_of_its_path():
    camera = Intrinsics(model="SIMPLE_PINHOLE", params=(320.0, 160.0, 120.0))
    other = dataclasses.replace(camera, params=(330.0, 160.0, 120.0))
    known = {"night/a.png": camera, "a.png": other}
    assert cameras_of_query("a.png", None) is None
    assert cameras_of_query("anything.png", camera) is camera
    assert cameras_of_query("photos/night/a.png", known) == {"photos/night/a.png": camera}
    assert cameras_of_query("photos/a.png", known) == {"photos/a.png": other}


def test_wrong_calls_are_one_sentence(plain, photos, scene, tmp_path, capsys):
    out, new = plain[0], photos / "photos" / "new.png"
    broken = photos / "photos" / "broken.png"
    assert "not a readable image" in says(capsys, broken, "--model", out)
    assert "cannot be read" in says(capsys, tmp_path / "none.png", "--model", out)
    assert "no finished run" in says(capsys, new, "--model", scene)
    assert "no such folder" in says(capsys, new, "--model", out, "--images", tmp_path / "none")
    assert "gone or changed" in says(capsys, new, "--model", out, "--images", scene)
    far = "PINHOLE:320,320,390,50"
    assert "principal point" in says(capsys, new, "--model", out, "--intrinsics", far)
    others = tmp_path / "cameras.txt"
    others.write_text("other.png SIMPLE_PINHOLE 320 240 320 160 120\n")
    said = says(capsys, new, "--model", out, "--intrinsics", others)
    assert f"the list has no camera of {new}" in said
    assert "--out" in says(capsys, new, "--model", out, "--out", tmp_path / "poses.txt")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda report: report["weights"].update(sha256="0" * 64), "other weights"),
        (lambda report: report.update(models=[]), "no model"),
        (lambda report: report["options"]["config"].update(colour="red"), "does not know"),
    ],
)
def test_a_run_that_cannot_serve_is_one_sentence(plain, photos, tmp_path, capsys, change, sentence):
    run = change_report(Path(shutil.copytree(plain[0], tmp_path / "run")), change)
    assert sentence in says(capsys, photos / "photos" / "new.png", "--model", run)
