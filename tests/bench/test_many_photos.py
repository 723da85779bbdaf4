"""Laws of what many photos are measured with: a rendered street, simulated matches, the driver, and
frames of a sequence."""

import dataclasses
import json
import sys

import numpy as np
import pytest

from jaxsfm.bench import driver, other_methods, sequence
from jaxsfm.bench.driver import NOISE_PX, REACH, SimulatedStreet
from jaxsfm.bench.inputs import chosen_frames, linked
from jaxsfm.bench.long_street import SIZE, walk, write_street
from jaxsfm.bench.model_options import SequenceOptions
from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.cli.main import main
from jaxsfm.colmap.poses import read_poses
from jaxsfm.errors import UserError
from jaxsfm.io.images import inspect_image
from jaxsfm.io.photo_folder import find_images


def test_a_street_has_photos_of_one_size_and_their_exact_cameras(street):
    names = find_images(street / "images")
    poses = read_poses(street / "reference")
    assert sorted(poses) == sorted(names) and len(names) == 11
    for name, pose in zip(sorted(poses), walk(11), strict=True):
        np.testing.assert_allclose(poses[name].centre, pose.centre, atol=1e-6)
        assert inspect_image(street / "images" / name).size == SIZE


def test_a_longer_street_begins_with_the_shorter_one(street, tmp_path):
    """So photos of a short street need not be rendered again."""
    write_street(tmp_path, 12)
    first = "photo00000.png"
    assert [p.centre.tolist() for p in walk(12)[:11]] == [p.centre.tolist() for p in walk(11)]
    same = (tmp_path / "images" / first).read_bytes() == (street / "images" / first).read_bytes()
    assert same


def test_simulated_keypoints_lie_a_pixel_from_where_the_camera_sees_their_points():
    photos = SimulatedStreet(3)
    one = photos.photo(1)
    assert len(one.points) > 200 and len(np.unique(one.cells)) == len(one.cells)
    pose, away = photos.poses[1], []
    for point, xy in zip(one.points, one.xy, strict=True):
        at = camera_matrix(SIZE) @ pose.rotation @ (photos.point(int(point)) - pose.centre)
        away.append(at[:2] / at[2] - xy)
    assert np.std(away) == pytest.approx(NOISE_PX, rel=0.15)


def test_simulated_matches_join_keypoints_of_one_point_and_depend_on_the_pair_alone():
    photos, others = SimulatedStreet(30), SimulatedStreet(30)
    pairs = photos.pairs()
    assert len(pairs) == sum(min(REACH, 29 - k) for k in range(30))
    found = photos.matches(pairs[5])
    again = [others.matches(pair) for pair in reversed(pairs)][-6]
    assert found.pair == again.pair and found.num_inliers > 50
    np.testing.assert_array_equal(found.cells, again.cells)
    np.testing.assert_array_equal(found.keypoints1, again.keypoints1)
    assert all(len(np.unique(column)) == len(column) for column in found.cells.T)


def test_the_driver_is_measured_stage_by_stage(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "NEAREST", 5)
    row = driver.measure(30, tmp_path)
    assert row["photos"] == 30 and row["pairs"] == len(SimulatedStreet(30).pairs())
    assert row["trusted pairs"] > 100
    assert all(row[stage] >= 0 for stage in ("keep", "read", "verification", "view graph"))
    json.dumps(row)


def test_frames_are_chosen_by_name_and_each_is_mapped_or_localized(street_sequence):
    folder = street_sequence
    every = chosen_frames(folder, 1, 0)
    assert len(every.mapped) == 11 and not every.localized
    second = chosen_frames(folder, 2, 3)
    assert [path.stem for path in second.localized] == ["photo00002", "photo00008"]
    assert len(second.mapped) == 4 and not {*second.mapped} & {*second.localized}
    with pytest.raises(UserError, match="fewer than three"):
        chosen_frames(folder, 5, 0) and chosen_frames(folder, 10, 0)


def linked_photos(folder) -> dict[str, str]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in found}


def test_a_folder_has_the_asked_photos_of_the_asked_folder_and_no_others(tmp_path):
    for folder in ("one", "two"):
        for name in ("a.jpg", "night/b.jpg", "night/c.jpg"):
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{folder} {name}")
    target = tmp_path / "links"
    linked(tmp_path / "one", ["a.jpg", "night/b.jpg"], target)
    assert linked_photos(target) == {"a.jpg": "one a.jpg", "night/b.jpg": "one night/b.jpg"}
    linked(tmp_path / "two", ["night/b.jpg", "night/c.jpg"], target)
    assert linked_photos(target) == {
        "night/b.jpg": "two night/b.jpg",
        "night/c.jpg": "two night/c.jpg",
    }
    (tmp_path / "two" / "night" / "b.jpg").unlink()
    linked(tmp_path / "one", ["night/b.jpg"], target)
    assert linked_photos(target) == {"night/b.jpg": "one night/b.jpg"}


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["--localize", "1"], "--localize must be 0 or at least 2; got 1"),
        (["--every", "0"], "--every: '0' is not a whole number of at least 1"),
        (["--every", ","], "--every: none given"),
        (["--methods", "rootsift"], "rootsift needs a preset beside it"),
        (["--methods", "aliked+lightglue"], "aliked+lightglue needs a preset beside it"),
        (["--methods", "sift"], "no method 'sift'"),
    ],
)
def test_options_of_a_sequence_that_make_no_sense_are_refused(tmp_path, capsys, given, says):
    both = ["--root", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(["bench", "sequence", *both, *given]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("camera", ["known", "start", "unknown"])
def test_the_camera_of_a_folder_is_held_adjusted_or_not_used(
    street_sequence, tmp_path, monkeypatch, camera
):
    seen = []

    def reconstruct(folder, out, *, config, options):
        seen.append((out.parent.name, options))
        raise UserError("seen")

    monkeypatch.setattr(sequence, "reconstruct_folder", reconstruct)
    options = SequenceOptions(root=street_sequence, intrinsics=camera, out=tmp_path)
    with pytest.raises(UserError, match="seen"):
        sequence.bench_sequence(dataclasses.replace(options, every=("2",)))
    ((folder, given),) = seen
    assert folder == ("every-2" if camera == "known" else f"every-2-{camera}")
    k = str(street_sequence / "K.txt")
    assert given.intrinsics == (None if camera == "unknown" else k)
    assert given.refines == (camera != "known")


def test_trained_networks_get_the_pairs_of_the_preset_beside_them(
    street_sequence, tmp_path, monkeypatch
):
    chosen = {("photo00000.jpg", "photo00002.jpg"), ("photo00002.jpg", "photo00004.jpg")}
    seen = []

    def write_lightglue_database(database, images, cameras, options, *, pairs, seconds):
        seen.append(([image.name for image in images], pairs))
        raise UserError("seen")

    monkeypatch.setattr(sequence, "trained_networks", lambda: None)
    monkeypatch.setattr(sequence, "with_jaxsfm", lambda given, name: ({}, chosen))
    monkeypatch.setattr(other_methods, "write_lightglue_database", write_lightglue_database)
    options = SequenceOptions(
        root=street_sequence, every=("2",), methods=("default,aliked+lightglue",), out=tmp_path
    )
    with pytest.raises(UserError, match="seen"):
        sequence.bench_sequence(options)
    ((names, pairs),) = seen
    assert names == [path.name for path in chosen_frames(street_sequence, 2, 0).mapped]
    assert pairs == sorted(chosen)


def test_networks_that_are_missing_are_missed_before_anything_is_matched(
    street_sequence, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setattr(sequence, "with_jaxsfm", lambda *_: pytest.fail("matched"))
    options = SequenceOptions(
        root=street_sequence, methods=("default,aliked+lightglue",), out=tmp_path
    )
    with pytest.raises(UserError, match="needs torch"):
        sequence.bench_sequence(options)


@pytest.mark.slow
def test_frames_are_mapped_and_localized_beside_rootsift(street_sequence, tmp_path, capsys):
    figures = tmp_path / "figures.json"
    options = ["--every", "1", "--localize", "5", "--out", str(tmp_path / "out")]
    given = ["--root", str(street_sequence), *options, "--json", str(figures)]
    assert main(["bench", "sequence", *given]) == 0
    printed = capsys.readouterr().out
    assert "2 of 2 within 0.05 and 5 deg" in printed and "rootsift" in printed
    ours, theirs = json.loads(figures.read_text())["rows"]
    assert (ours["method"], theirs["method"]) == ("default", "rootsift")
    assert ours["registered"] == ours["frames"] == 9
    assert ours["position"] < 0.02 and ours["localized"]["near"] == 2
    assert theirs["registered"] >= 3 and theirs["localized"]["frames"] == 2
    assert theirs["localized"]["near"] == theirs["localized"]["placed"]
    assert ours["seconds"].keys() >= {"extraction", "matching", "mapping", "refinement"}
