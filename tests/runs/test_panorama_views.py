"""Laws of the folder of views that a run makes of its panoramas."""

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxsfm.colmap.poses import CameraPose
from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.panoramas import read_panorama, render_views
from jaxsfm.io.photo_folder import find_images, with_masks
from jaxsfm.matching.pipeline import open_images
from jaxsfm.options import WeightsChoice
from jaxsfm.runs import extend, panoramas, reconstruct, run_inputs, view_folder
from jaxsfm.runs.localize import open_queries
from jaxsfm.runs.panoramas import (
    VIEW_SET,
    PanoramaPlan,
    panorama_rig,
    panoramas_among,
    planned_panoramas,
    view_name,
    views_of,
)
from jaxsfm.runs.run_options import LocalizeOptions, RunOptions
from jaxsfm.runs.view_folder import panorama_views

GPANO = b'<x xmlns:GPano="g" GPano:ProjectionType="equirectangular"/>'
WIDTH = 512


@pytest.fixture
def photos(tmp_path) -> Path:
    """Two panoramas, one of them as PNG without a note, and an ordinary photo."""
    folder = tmp_path / "photos"
    (folder / "sub").mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 255, (16, 32, 3), np.uint8)
    smooth = Image.fromarray(cv2.resize(noise, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_CUBIC))
    smooth.save(folder / "a.jpg", quality=95, xmp=GPANO)
    smooth.save(folder / "sub" / "b.png")
    Image.fromarray(noise).resize((320, 240)).save(folder / "sub" / "c.jpg")
    return folder


def of(folder: Path, *names: str) -> list[ImageFile]:
    return [image for image in open_images(folder)[0] if image.name in names]


def plan_of(photos: Path, images=None, names=("a.jpg", "sub/b.png"), nadir_deg=0.0):
    images = images or open_images(photos)[0]
    return PanoramaPlan(
        panoramas=[image for image in images if image.name in names],
        others=[image for image in images if image.name not in names],
        side=VIEW_SET.side(WIDTH, 1600),
        nadir_deg=nadir_deg,
    )


def written(photos: Path, out: Path, **plan):
    return panorama_views(plan_of(photos, **plan), out)


def test_photos_that_say_so_are_panoramas(photos):
    images = open_images(photos)[0]
    assert [image.name for image in panoramas_among(images, "auto")] == ["a.jpg"]
    assert panoramas_among(images, "no") == []
    both = of(photos, "a.jpg", "sub/b.png")
    assert panoramas_among(both, "yes") == both


def test_a_panorama_that_is_not_twice_as_wide_as_high_is_named(photos):
    with pytest.raises(UserError, match=r"twice as wide as high, but sub/c.jpg has 320 x 240"):
        panoramas_among(open_images(photos)[0], "yes")


def test_localize_says_that_it_takes_no_panoramas(photos):
    usable, unusable = open_queries([photos])
    assert {Path(path).name for path in usable} == {"b.png", "c.jpg"}
    (why,) = unusable.values()
    assert "a.jpg: localize takes no 360-degree photos" in why


@pytest.mark.parametrize(
    ("choice", "skipped", "added", "told"),
    [("auto", {}, False, True), ("auto", {"a.jpg": "why"}, False, False), ("no", {}, True, False)],
)
def test_extend_says_that_it_takes_no_panoramas(photos, choice, skipped, added, told):
    run = Mock()
    run.store.why_unusable.return_value = None
    run.report.images.skipped, run.report.identity.images = skipped, {}
    run.report.options = {"panorama": choice}
    images, unusable = extend._added_photos(run, open_images(photos)[0], {})
    assert images.keys() == {"sub/b.png", "sub/c.jpg"} | ({"a.jpg"} if added else set())
    assert unusable.keys() == ({"a.jpg"} if told else set())
    assert all("extend takes no 360-degree photos" in why for why in unusable.values())


def test_a_run_of_panoramas_is_not_extended(photos, tmp_path, monkeypatch):
    written(photos, out := tmp_path / "out")
    (out / "run.json").write_text("{}")
    monkeypatch.setattr(extend, "read_run", lambda *_, **__: Mock())
    with pytest.raises(UserError, match="a run of 360-degree photos cannot be extended"):
        extend.extend_run(out, options=LocalizeOptions())


def test_placed_panoramas_are_counted(photos, tmp_path, monkeypatch):
    views = written(photos, tmp_path / "out")
    pose = CameraPose(np.eye(3), np.zeros(3))
    poses = iter([dict.fromkeys(views_of("a.jpg")[:3], pose), {"pano_camera0/sub/b.png.jpg": pose}])
    monkeypatch.setattr(panoramas, "model_poses", lambda _: next(poses))
    placed = views.write_poses(tmp_path, [Mock(), Mock()])
    assert (placed.found, placed.registered) == (2, 1)
    assert views.write_poses(tmp_path, []).registered == 0


def test_each_view_has_a_folder_and_shows_what_the_rig_says(photos, tmp_path):
    (tmp_path / "out").mkdir()
    found = written(photos, tmp_path / "out", names=("a.jpg",))
    side = VIEW_SET.side(WIDTH, 1600)
    rgb = np.asarray(Image.open(photos / "a.jpg"))
    for number, view in enumerate(render_views(rgb, VIEW_SET, side)):
        name = f"pano_camera{number}/a.jpg"
        assert found.view_of[name] == ("a.jpg", number)
        stored = np.asarray(Image.open(found.folder / name)).astype(float)
        assert np.abs(stored - view).mean() < 2
    focal, cx, cy = found.rig.cameras[3].params
    assert (focal, cx, cy) == (pytest.approx(side / 2), side / 2, side / 2)  # 90 degrees
    for camera, turn in zip(found.rig.cameras, VIEW_SET.rotations(), strict=True):
        np.testing.assert_allclose(camera.rotation, turn, atol=1e-12)
        assert camera.translation is not None and not camera.translation.any()
    assert found.masks is None and found.panoramas == ["a.jpg"]


def test_photos_that_are_no_panoramas_are_copied(photos, tmp_path):
    (tmp_path / "out").mkdir()
    found = written(photos, tmp_path / "out")
    copy, photo = found.folder / "sub" / "c.jpg", photos / "sub" / "c.jpg"
    assert copy.read_bytes() == photo.read_bytes()
    assert {*find_images(found.folder)} == {"sub/c.jpg", *found.view_of}
    assert "pano_camera5/sub/b.png.jpg" in found.view_of


def test_views_are_written_once(photos, tmp_path):
    (tmp_path / "out").mkdir()

    def made(**options) -> int:
        views = written(photos, tmp_path / "out", **options)
        return (views.folder / "pano_camera0" / "a.jpg").stat().st_mtime_ns

    first = made()
    assert made() == first
    assert (second := made(nadir_deg=50.0)) > first
    (tmp_path / "out" / "views" / "pano_camera1" / "a.jpg").unlink()
    assert made(nadir_deg=50.0) > second


def content(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for name in ("views", "view_masks")
        for path in (folder / name).rglob("*")
        if path.is_file()
    }


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


@pytest.mark.parametrize("harm", [Path.unlink, cut, flip])
@pytest.mark.parametrize(
    ("name", "rendered"),
    [
        ("views/pano_camera3/a.jpg", ["a.jpg"]),
        ("view_masks/pano_camera3/a.jpg.png", ["a.jpg"]),
        ("view_masks/pano_camera0/sub/b.png.jpg.png", ["sub/b.png"]),
        ("views/sub/c.jpg", []),
        ("view_masks/sub/c.jpg.png", []),
        ("views/views.json", ["a.jpg", "sub/b.png"]),
    ],
)
def test_what_is_deleted_or_damaged_is_made_again(
    photos, tmp_path, monkeypatch, name, rendered, harm
):
    """And the views of other panoramas are not rendered again."""
    out, masks = tmp_path / "out", tmp_path / "masks"
    (masks / "sub").mkdir(parents=True)
    Image.new("L", (320, 240), 255).save(masks / "sub" / "c.jpg.png")
    images = with_masks(open_images(photos)[0], masks)[0]
    first = written(photos, out, images=images, nadir_deg=60.0)
    (out / "run.json").write_text(json.dumps({"images": {min(first.view_of): "0"}}))
    whole, seen = content(out), []
    assert len(whole) == 2 * (12 + 1) + 1

    def noted(image):
        seen.append(image.name)
        return read_panorama(image)

    monkeypatch.setattr(view_folder, "read_panorama", noted)
    harm(out / name)
    again = written(photos, out, images=images, nadir_deg=60.0)
    assert content(out) == whole and seen == rendered
    assert dataclasses.replace(again, rig=first.rig) == first


def test_deleted_views_are_made_again_for_the_run_that_had_them(photos, tmp_path):
    out = tmp_path / "out"
    found = written(photos, out)
    whole = content(out)
    for images, made_again in (({"other.jpg": "0"}, False), ({min(found.view_of): "0"}, True)):
        shutil.rmtree(out / "views", ignore_errors=True)
        (out / "run.json").write_text(json.dumps({"images": images}))
        if made_again:
            written(photos, out)
            assert content(out) == whole
        else:
            with pytest.raises(UserError, match="run of other photos"):
                written(photos, out)


def test_only_views_of_a_new_panorama_are_rendered(photos, tmp_path, monkeypatch):
    out, seen = tmp_path / "out", []
    written(photos, out)
    (photos / "b.jpg").write_bytes((photos / "a.jpg").read_bytes())
    monkeypatch.setattr(
        view_folder, "read_panorama", lambda image: seen.append(image.name) or read_panorama(image)
    )
    found = written(photos, out, names=("a.jpg", "b.jpg", "sub/b.png"))
    assert seen == ["b.jpg"] and len(found.view_of) == 18


def test_the_nadir_is_masked(photos, tmp_path):
    (tmp_path / "out").mkdir()
    found = written(photos, tmp_path / "out", nadir_deg=60.0)
    assert found.masks is not None
    masked, bare = with_masks(open_images(found.folder)[0], found.masks)
    assert bare == ["sub/c.jpg"]
    used = cv2.imread(str(found.masks / "pano_camera2" / "a.jpg.png"), cv2.IMREAD_GRAYSCALE) > 0
    middle = used[:, used.shape[1] // 2]  # 60 degrees from straight down are 30 below the horizon
    below = (np.flatnonzero(~middle)[0] - len(middle) / 2) / (len(middle) / 2)
    assert np.degrees(np.arctan(below)) == pytest.approx(30, abs=1)


def test_masks_of_photos_become_masks_of_views(photos, tmp_path):
    (tmp_path / "out").mkdir()
    masks = tmp_path / "masks"
    (masks / "sub").mkdir(parents=True)
    half = np.zeros((WIDTH // 2, WIDTH), np.uint8)
    half[:, WIDTH // 4 : 3 * WIDTH // 4] = 255  # what lies ahead
    Image.fromarray(half).save(masks / "a.jpg.png")
    Image.fromarray(np.full((240, 320), 255, np.uint8)).save(masks / "sub" / "c.jpg.png")
    images = with_masks(open_images(photos)[0], masks)[0]
    found = written(photos, tmp_path / "out", images=images)
    assert found.masks is not None
    assert (found.masks / "sub" / "c.jpg.png").is_file()
    used = {
        number: cv2.imread(str(found.masks / view_name("a.jpg", number)) + ".png", 0).mean() / 255
        for number in (0, 1, 2)
    }
    # They end at the headings 15 .. 105 and 75 .. 165 degrees, and the mask at 90.
    edge = np.tan(np.radians(30))
    wanted = [1, (1 + edge) / 2, (1 - edge) / 2]
    assert [used[k] for k in range(3)] == pytest.approx(wanted, abs=0.02)
    # Nothing of the view to the back is used, so it is not there.
    assert "pano_camera3/a.jpg" not in found.view_of
    assert "pano_camera3/sub/b.png.jpg" in found.view_of


def test_a_rig_without_the_first_view_has_another_reference():
    whole, part = panorama_rig(100, range(6)), panorama_rig(100, [4, 2])
    assert [each.prefix for each in part.cameras] == ["pano_camera2/", "pano_camera4/"]
    np.testing.assert_array_equal(part.cameras[0].rotation, np.eye(3))
    turn = whole.cameras[4].rotation @ whole.cameras[2].rotation.T
    np.testing.assert_allclose(part.cameras[1].rotation, turn, atol=1e-12)


def test_a_photo_in_a_folder_of_the_views_is_refused(photos, tmp_path):
    (photos / "sub").rename(photos / "pano_camera2")
    with pytest.raises(UserError, match="pano_camera2/.*rename"):
        planned_panoramas(open_images(photos)[0], Config(), RunOptions())


@pytest.mark.parametrize("nadir", [-1.0, 90.0, float("nan")])
def test_the_nadir_is_less_than_half_of_the_sphere(nadir):
    with pytest.raises(UserError, match="--nadir must lie in 0 .. 90"):
        planned_panoramas([], Config(), RunOptions(nadir=nadir))


def test_the_first_view_has_the_axes_of_the_panorama():
    np.testing.assert_allclose(VIEW_SET.rotations()[0], np.eye(3), atol=1e-12)


class Stopped(Exception):
    """Raised where the run would begin to match."""


def test_a_run_matches_the_views_but_not_those_of_one_panorama(photos, tmp_path, monkeypatch):
    given = {}

    def stop(**arguments):
        given.update(arguments)
        raise Stopped

    weights = SimpleNamespace(sha256="0", chosen_relocalizer=lambda config: None)
    monkeypatch.setattr(run_inputs, "chosen_weights", lambda *_: weights)
    monkeypatch.setattr(reconstruct, "RunPhotos", stop)
    Image.open(photos / "sub" / "b.png").save(photos / "b.jpg", xmp=GPANO)
    (photos / "sub" / "b.png").unlink()
    out = tmp_path / "out"
    with pytest.raises(Stopped):
        reconstruct.reconstruct_folder(photos, out, config=Config(), options=RunOptions())
    views = {f"pano_camera{k}/{name}" for k in range(6) for name in ("a.jpg", "b.jpg")}
    assert given["images"].keys() == views | {"sub/c.jpg"}
    assert (out / "views" / "pano_camera0" / "a.jpg").is_file()
    pairs = given["pairs"]
    assert len(pairs) == 6 * 6 + 12
    assert all(Path(a).name != Path(b).name for a, b in pairs)


def test_known_cameras_are_not_taken_beside_panoramas(photos, tmp_path):
    options = RunOptions(intrinsics="SIMPLE_PINHOLE:300,160,120")
    with pytest.raises(UserError, match=r"--intrinsics: .* panoramas \(a.jpg\)"):
        reconstruct.reconstruct_folder(photos, tmp_path / "out", config=Config(), options=options)
    assert not (tmp_path / "out").exists()


def test_pairs_of_panoramas_are_pairs_of_their_views(photos):
    plan = plan_of(photos)
    found = plan.pairs([("a.jpg", "sub/b.png"), ("a.jpg", "sub/c.jpg"), ("a.jpg", "sub/b.png")])
    views, others = views_of("a.jpg"), [*views_of("sub/b.png"), "sub/c.jpg"]
    assert found == sorted((min(a, b), max(a, b)) for a in views for b in others)
    assert plan.pairs([(views[0], "sub/c.jpg")]) == [(views[0], "sub/c.jpg")]
    assert plan.pairs([("a.jpg", views[0]), (views[0], views[1])]) == []


def inputs_of(photos, **options):
    chosen = RunOptions(**{"pairs": "exhaustive", **options})
    return run_inputs.read_inputs(open_images(photos)[0], plan_of(photos), [], (), Config(), chosen)


@pytest.fixture
def no_weights(monkeypatch):
    weights = SimpleNamespace(sha256="0", chosen_relocalizer=lambda config: None)
    monkeypatch.setattr(run_inputs, "chosen_weights", lambda *_: weights)


def test_a_file_of_pairs_names_panoramas(photos, tmp_path, no_weights):
    (tmp_path / "pairs.txt").write_text("a.jpg sub/b.png\npano_camera0/a.jpg sub/c.jpg\n")
    assert len(inputs_of(photos, pairs=str(tmp_path / "pairs.txt")).pairs) == 36 + 1


def test_the_position_of_a_panorama_is_that_of_its_views(photos, tmp_path, no_weights):
    table = tmp_path / "table.csv"
    table.write_text("image,x,y,z\nA.JPG,1,2,3\nsub/b.png,4,5,6\nsub/c.jpg,7,8,10\n")
    measured = inputs_of(photos, georeference=str(table)).measured
    assert measured is not None
    wanted = dict.fromkeys(views_of("a.jpg"), (1, 2, 3)) | {"sub/c.jpg": (7, 8, 10)}
    wanted |= dict.fromkeys(views_of("sub/b.png"), (4, 5, 6))
    assert {name: at[:3] for name, at in measured.positions.items()} == wanted
    table.write_text("image,x,y,z\na.jpg,1,2,3\nsub/c.jpg,7,8,10\n")
    with pytest.raises(UserError, match="2 photos of the folder have a position"):
        inputs_of(photos, georeference=str(table))  # six views are one position


def test_gps_positions_count_once_for_each_panorama(photos, no_weights):
    for name, north in (("a.jpg", 30.0), ("d.jpg", 31.0)):
        exif = Image.Exif()
        place = {1: "N", 2: (50.0, north, 0.0), 3: "E", 4: (4.0, 0.0, 0.0), 5: b"\0", 6: 120.0}
        exif.get_ifd(0x8825).update(place)
        Image.new("RGB", (WIDTH, WIDTH // 2)).save(photos / name, exif=exif, xmp=GPANO)
    images = open_images(photos)[0]
    plan = planned_panoramas(images, Config(), RunOptions())
    options = RunOptions(pairs="exhaustive")
    found = run_inputs.read_inputs(images, plan, [], (), Config(), options).measured
    assert found is not None
    assert found.positions.keys() == {*views_of("a.jpg"), *views_of("d.jpg")}
    with pytest.raises(UserError, match="2 photos have a GPS position"):
        options = dataclasses.replace(options, georeference="gps")
        run_inputs.read_inputs(images, plan, [], (), Config(), options)


def test_control_points_are_measured_in_panoramas_or_in_views(photos, tmp_path, no_weights):
    (photos / "sub" / "d.jpg").write_bytes((photos / "sub" / "c.jpg").read_bytes())
    ahead, zenith, side = (WIDTH / 2 - 0.5, WIDTH / 4 - 0.5), (10, 2), VIEW_SET.side(WIDTH, 1600)
    rows = [
        f"{k},{k},{k * k},{k**3},{name},{x},{y}"
        for k in range(3)
        for name, (x, y) in (
            ("a.jpg", ahead),
            ("a.jpg", ahead) if not k else ("sub/b.png", zenith),
            ("pano_camera2/a.jpg", (7, 8)),
            ("sub/d.jpg", (3, 4)),
        )[k > 0 :]
    ]
    rows = list(dict.fromkeys(rows))
    (tmp_path / "t.csv").write_text("\n".join(["point,x,y,z,image,px,py", *rows]))
    measured = inputs_of(photos, georeference=str(tmp_path / "t.csv")).measured
    assert measured is not None
    middle = (side - 1) / 2
    front = [(view_name("a.jpg", 0), pytest.approx(middle), pytest.approx(middle))]
    others = [("pano_camera2/a.jpg", 7, 8), ("sub/d.jpg", 3, 4)]
    seen = {point.name: [each[:3] for each in point.seen] for point in measured.points}
    assert seen == {"0": front + others, "1": others, "2": others}


RIG = '[{"cameras": [{"image_prefix": "%s", "ref_sensor": true}]}]'
FILES = {
    "pairs.txt": "a.jpg nobody.jpg\n",
    "table.csv": "image,x,y,z\nnobody.jpg,1,2,3\n",
    "no.json": RIG % "left/",
    "ours.json": RIG % "pano_camera1/",
}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"nadir": 120.0}, "--nadir must lie"),
        ({"masks": Path("nowhere")}, "--masks .*nowhere: no such folder"),
        ({"masks": Path("masks")}, "a.jpg.png: the mask has 8 x 8 pixels"),
        ({"rig": Path("nowhere.json")}, "--rig .*nowhere.json"),
        ({"rig": Path("no.json")}, "--rig: no photo has a name that begins with left/"),
        ({"rig": Path("ours.json")}, "--rig.* pano_camera1/ is the prefix of two cameras"),
        ({"pairs": "sequental:3"}, "--pairs sequental:3"),
        ({"pairs": "pairs.txt"}, "--pairs .*pairs.txt line 1: no image named 'nobody.jpg'"),
        ({"georeference": "nowhere.csv"}, "--georeference .*nowhere.csv: no such file"),
        ({"georeference": "table.csv"}, "--georeference .*table.csv: 0 photos"),
        ({"with_database": Path("nowhere.db")}, "--with-database .*nowhere.db"),
        ({"cameras": "single"}, "--cameras single"),
        ({"network": WeightsChoice(weights=Path("nowhere.npz"))}, "nowhere.npz"),
    ],
)
def test_options_are_checked_before_a_view_is_rendered(photos, tmp_path, monkeypatch, given, words):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "masks").mkdir()
    Image.new("L", (8, 8), 255).save(tmp_path / "masks" / "a.jpg.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(view_folder, "render_views", None)
    with pytest.raises(UserError, match=words) as raised:
        reconstruct.reconstruct_folder(
            photos, tmp_path / "out", config=Config(), options=RunOptions(**given)
        )
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_a_panorama_whose_views_would_be_too_small_is_named(tmp_path):
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (128, 64)).save(tmp_path / name, xmp=GPANO)
    with pytest.raises(UserError, match=r"a.jpg: .* 128 pixels width has views of 41 pixels"):
        planned_panoramas(open_images(tmp_path)[0], Config(), RunOptions())


def test_one_panorama_is_too_few_photos(tmp_path):
    Image.new("RGB", (WIDTH, WIDTH // 2)).save(tmp_path / "a.jpg", xmp=GPANO)
    with pytest.raises(UserError, match="1 usable images, at least 2 are needed"):
        reconstruct.reconstruct_folder(
            tmp_path, tmp_path / "out", config=Config(), options=RunOptions()
        )
