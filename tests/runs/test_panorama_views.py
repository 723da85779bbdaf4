"""Laws of the folder of views that a run makes of its panoramas."""

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from jaxsfm.config import Config
from jaxsfm.errors import UserError
from jaxsfm.io.images import ImageFile
from jaxsfm.io.panoramas import read_panorama, render_views
from jaxsfm.io.photo_folder import find_images, with_masks
from jaxsfm.matching.pipeline import open_images
from jaxsfm.options import WeightsChoice
from jaxsfm.runs import reconstruct, run_inputs, view_folder
from jaxsfm.runs.localize import open_queries
from jaxsfm.runs.panoramas import (
    VIEW_SET,
    PanoramaPlan,
    panorama_rig,
    panoramas_among,
    planned_panoramas,
    view_name,
)
from jaxsfm.runs.run_options import RunOptions
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


RIG = '[{"cameras": [{"image_prefix": "%s", "ref_sensor": true}]}]'
FILES = {
    "pairs.txt": "pano_camera0/a.jpg nobody.jpg\n",
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
