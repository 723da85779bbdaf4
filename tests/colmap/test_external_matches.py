"""Somebody else's matches beside ours: one list of keypoints per image, one model."""

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from foreign_model import NAMES, SIZE, camera, exact_model, image_files, results_of
from mapped import map_database, verified

from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.external_matches import NO_EXTERNAL_MATCHES, JoinedMatches, read_external_matches
from jaxsfm.colmap.formats.database import read_database
from jaxsfm.colmap.formats.hloc import FEATURES, MATCHES, write_hloc
from jaxsfm.colmap.intrinsics import Intrinsics
from jaxsfm.colmap.map_options import MapOptions
from jaxsfm.colmap.mapper import build_models
from jaxsfm.colmap.model import Model
from jaxsfm.colmap.poses import model_poses
from jaxsfm.errors import UserError

KNOWN = Intrinsics(model="PINHOLE", params=(900.0, 900.0, 512.0, 384.0))
MODEL = exact_model([camera("PINHOLE", 1, list(KNOWN.params))], points=240)
IMAGES = image_files(NAMES, Path("nowhere"))
ONE = MapOptions(refine_intrinsics=False, threads=1)


def write_theirs(path, results, images=IMAGES, *, verified=False):
    """A database as another tool makes it: the same photos, its own keypoints."""
    write_database(path, images, results, Cameras(known=KNOWN))
    if verified:
        with pycolmap.Database.open(path) as db:
            ids = {image.name: image.image_id for image in db.read_all_images()}
            for a, b in results:
                inliers = np.asarray(db.read_matches(ids[a], ids[b]))[::2]
                geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=inliers)
                db.write_two_view_geometry(ids[a], ids[b], geometry)
    return path


@pytest.fixture
def halves():
    """Ours: even points, pairs of the first two images and the next; theirs: odd points."""
    ours = results_of(MODEL, lambda point_id: point_id % 2 == 0)
    theirs = results_of(MODEL, lambda point_id: point_id % 2 == 1)
    return ours, theirs


def merged_database(path, ours, given):
    names = set(NAMES)
    write_database(path, IMAGES, JoinedMatches(ours, given, names), Cameras(known=KNOWN))
    return read_database(path, where="merged")


@pytest.mark.parametrize("verified", [False, True])
def test_theirs_come_first_and_every_match_keeps_its_two_places(tmp_path, halves, verified):
    ours, theirs = halves
    path = write_theirs(tmp_path / "theirs.db", theirs, verified=verified)
    given = read_external_matches(path, None, IMAGES, KNOWN)
    merged = merged_database(tmp_path / "merged.db", ours, given)
    own = read_database(path, where="theirs")
    for name in NAMES:
        known = {tuple(np.round(xy, 2)) for xy in own.keypoints[name]}
        from_them = [tuple(np.round(xy, 2)) in known for xy in merged.keypoints[name]]
        count = sum(from_them)
        assert 0 < count < len(from_them) and all(from_them[:count])
    for pair, rows in merged.matches.items():
        at = [merged.keypoints[name][column] for name, column in zip(pair, rows.T, strict=True)]
        found = {tuple(np.round(np.r_[a, b], 2)) for a, b in zip(*at, strict=True)}
        step = 2 if verified else 1
        # verified: every second match of theirs is an inlier; the others are left out
        wanted = [np.c_[r.keypoints0, r.keypoints1] for r in (ours[pair], theirs[pair])]
        assert len(rows) == len(wanted[0]) + len(own.matches[pair][::step])
        assert {tuple(np.round(row, 2)) for row in wanted[0]} <= found
        assert found <= {tuple(np.round(row, 2)) for row in np.concatenate(wanted)}
    assert given.about is not None and given.about["verified"] == verified


def test_without_any_given_ours_are_as_they_were(halves):
    ours, _ = halves
    beside = JoinedMatches(ours, NO_EXTERNAL_MATCHES, set(NAMES))
    assert list(beside) == sorted(ours) and len(beside) == len(ours)
    for pair in ours:
        assert np.array_equal(beside[pair].cells, ours[pair].cells)
    assert read_external_matches(None, None, IMAGES, None) is NO_EXTERNAL_MATCHES


def test_images_that_neither_connects_alone_come_into_one_model(tmp_path, halves):
    """Ours join the first three images, theirs each of these and the fourth. COLMAP has to start
    from one of their pairs, for no keypoint of theirs is one of ours."""
    ours, theirs = halves
    ours = {pair: r for pair, r in ours.items() if NAMES[3] not in pair}
    theirs = {pair: r for pair, r in theirs.items() if NAMES[3] in pair}
    given = read_external_matches(write_theirs(tmp_path / "theirs.db", theirs), None, IMAGES, KNOWN)
    write_database(tmp_path / "ours.db", IMAGES, ours, Cameras(known=KNOWN))
    (alone,) = map_database(tmp_path / "ours.db", ONE)
    assert sorted(model_poses(alone)) == NAMES[:3]
    merged_database(tmp_path / "both.db", ours, given)
    (both,) = build_models(tmp_path / "both.db", verified(tmp_path / "both.db", ONE), ONE)
    assert sorted(model_poses(both)) == NAMES
    assert both.compute_mean_reprojection_error() < 0.01


def test_hlocs_files_give_what_the_database_gives(tmp_path, halves):
    _, theirs = halves
    path = write_theirs(tmp_path / "theirs.db", theirs)
    tables = read_database(path, where="theirs")
    write_hloc(tmp_path, tables, tables.matches, dict.fromkeys(NAMES, 1.0))
    one = read_external_matches(path, None, IMAGES, KNOWN)
    other = read_external_matches(None, (tmp_path / FEATURES, tmp_path / MATCHES), IMAGES, KNOWN)
    for name in NAMES:
        assert np.array_equal(one.keypoints[name], other.keypoints[name])
    for pair, rows in one.matches.items():
        assert set(map(tuple, rows)) == set(map(tuple, other.matches[pair]))


def test_refinement_reads_tracks_whatever_the_order_of_keypoints():
    """It looks at observations; the index of a keypoint, a cell of ours or not, is only a place."""
    sizes = {name: (SIZE, (1.0, 1.0)) for name in NAMES}
    shuffled = pycolmap.Reconstruction()
    shuffled.add_camera_with_trivial_rig(MODEL.camera(1))
    place, rng = {}, np.random.default_rng(0)
    for image_id, image in sorted(MODEL.images.items()):
        xy = np.asarray([point.xy for point in image.points2D])
        order = rng.permutation(len(xy))
        place[image_id] = np.argsort(order)
        new = pycolmap.Image(name=image.name, camera_id=1, image_id=image_id, keypoints=xy[order])
        shuffled.add_image_with_trivial_frame(new, image.cam_from_world())
    for point_id in sorted(MODEL.points3D):
        point, track = MODEL.point3D(point_id), pycolmap.Track()
        for element in point.track.elements:
            track.add_element(element.image_id, int(place[element.image_id][element.point2D_idx]))
        shuffled.add_point3D(point.xyz, track, point.color)
    one, other = (Model.from_colmap(m, sizes).tracks for m in (MODEL, shuffled))
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(a, b)


def test_images_of_the_database_alone_are_ignored_with_a_note(
    tmp_path, halves, caplog, monkeypatch
):
    _, theirs = halves
    path = write_theirs(tmp_path / "theirs.db", theirs)
    monkeypatch.setattr(logging.getLogger("jaxsfm"), "propagate", True)
    with caplog.at_level(logging.WARNING):
        given = read_external_matches(path, None, IMAGES[:3], KNOWN)
    assert NAMES[3] in caplog.text and "1 images" in caplog.text
    assert sorted(given.keypoints) == NAMES[:3]
    assert given.about is not None and given.about["ignored"] == [NAMES[3]]
    assert all(NAMES[3] not in pair for pair in given.matches)


def test_images_that_are_not_mapped_take_their_pairs_with_them(tmp_path, halves):
    _, theirs = halves
    given = read_external_matches(write_theirs(tmp_path / "theirs.db", theirs), None, IMAGES, KNOWN)
    beside = JoinedMatches({}, given, set(NAMES[:2]))
    assert list(beside) == [(NAMES[0], NAMES[1])]
    with pytest.raises(KeyError):
        beside[NAMES[0], NAMES[3]]


def test_many_to_one_matches_become_one_to_one(tmp_path, halves):
    _, theirs = halves
    path = write_theirs(tmp_path / "theirs.db", theirs)
    a, b = min(theirs)
    with pycolmap.Database.open(path) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        rows = np.asarray(db.read_matches(ids[a], ids[b]))
        twice = rows.copy()
        twice[1] = rows[0, 0], rows[1, 1]  # a keypoint of the first image again,
        twice[7, 1] = rows[5, 1]  # and one of the second
        db.delete_matches(ids[a], ids[b])
        db.write_matches(ids[a], ids[b], twice)
    given = read_external_matches(path, None, IMAGES, KNOWN)
    kept = given.matches[a, b]
    assert all(len(np.unique(column)) == len(kept) for column in kept.T)
    assert len(kept) == len(rows) - 2


def of_size(size):
    return [dataclasses.replace(image, size=size) for image in IMAGES]


@pytest.mark.parametrize(
    ("images", "intrinsics", "message"),
    [
        (of_size((1024, 767)), None, "1024 x 768 pixels there, but the photo 1024 x 767"),
        (IMAGES, Intrinsics(model="PINHOLE", params=(700, 700, 512, 384)), "focal length of 900"),
        (image_files(["other.jpg"], IMAGES[0].path), None, "none of its images"),
    ],
)
def test_other_photos_sizes_and_cameras_are_refused(tmp_path, halves, images, intrinsics, message):
    path = write_theirs(tmp_path / "theirs.db", halves[1])
    with pytest.raises(UserError, match=f"--with-database .*theirs.db: .*{message}"):
        read_external_matches(path, None, images, intrinsics)


@pytest.mark.parametrize(("shift", "accepted"), [(0.9, True), (3.0, False)])
def test_keypoints_on_the_border_are_pulled_in_and_beyond_refused(
    tmp_path, halves, shift, accepted
):
    tables = read_database(write_theirs(tmp_path / "t.db", halves[1]), where="t")
    xy = tables.keypoints[NAMES[0]]
    xy[3] = SIZE[0] - 0.5 + shift, 10
    write_hloc(tmp_path, tables, tables.matches, dict.fromkeys(NAMES, 1.0))
    files = tmp_path / FEATURES, tmp_path / MATCHES
    if accepted:
        given = read_external_matches(None, files, IMAGES, None)
        assert given.keypoints[NAMES[0]][3].tolist() == [SIZE[0] - 0.5, 10]
    else:
        with pytest.raises(UserError, match=r"--with-hloc: a\.jpg has keypoints outside"):
            read_external_matches(None, files, IMAGES, None)


def test_one_source_at_a_time(tmp_path):
    with pytest.raises(
        UserError, match="--with-database, --with-hloc and --with-dense: give only one"
    ):
        read_external_matches(tmp_path, (tmp_path, tmp_path), IMAGES, None)


def test_a_lost_image_is_judged_by_both(tmp_path, halves):
    ours, theirs = halves
    given = read_external_matches(write_theirs(tmp_path / "theirs.db", theirs), None, IMAGES, KNOWN)
    pair, other = sorted(ours)[:2]
    mine = {pair: ours[pair].counts._replace(num_inliers=0), other: ours[other].counts}
    counts = given.counts(mine)
    assert counts[pair].num_inliers == len(given.matches[pair])
    assert counts[other] == ours[other].counts
    assert json.dumps(given.about)
