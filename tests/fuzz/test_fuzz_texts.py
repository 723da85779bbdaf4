"""Damaged pair files, intrinsics, camera files: what they say, or a sentence that names them."""

import numpy as np
from fuzz_children import run_cases
from mutations import damaged_text, outcome

from jaxsfm.bench.aachen import PAIRS as AACHEN_PAIRS
from jaxsfm.bench.aachen import read_cameras, read_nvm, read_subsets
from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.colmap.given_cameras import parse_cameras
from jaxsfm.colmap.intrinsics import check_fits
from jaxsfm.colmap.poses import read_poses
from jaxsfm.io.pairs import read_pairs
from jaxsfm.io.position_tables import read_position_table

NAMES = ["a.jpg", "b c.jpg", "sub/d.jpg", "\u65e5.png", "#e.jpg"]
PAIRS = "# pairs\na.jpg sub/d.jpg\na.jpg b c.jpg\n\u65e5.png\ta.jpg\n\nb c.jpg\tsub/d.jpg\n"
MODELS = (
    "PINHOLE:600,610.5,320,240",
    "SIMPLE_RADIAL:600,320,240,-0.1",
    "OPENCV:600,600,320,240,0.1,0.01,0,0",
    "FULL_OPENCV:600,600,320,240,0,0,0,0,0,0,0,0",
    "FOV:600,600,320,240,0.9",
)
SIZE = (640, 480)
K = "\n".join(" ".join(f"{v}" for v in row) for row in camera_matrix(SIZE))
CAMERAS = (
    "db/1.jpg SIMPLE_RADIAL 1600 1200 1469.2 800 600 -0.03\n"
    "query/night/n.jpg PINHOLE 640 480 600 610.5 320 240\n"
)
NIGHTS = "db/1.jpg query/night/n.jpg\ndb/2.jpg query/night/n.jpg\ndb/1.jpg db/2.jpg\n"
SUBSETS = "# subsets\nquery/night/n.jpg db/1.jpg db/2.jpg\n"
NVM = (
    "NVM_V3\n\n2\ndb/1.jpg 600 0.8 0.6 0 0 1.5 -2 0.25 0 0\n"
    "db/2.jpg 600 1 0 0 0 2.5 -2 0.25 -0.1 0\n\n0\n"
)
TABLES = (
    "image,lat,lon,alt\na.jpg,46.5,-91.25,198\nb c.jpg,46.6,-91.5,200.5\n",
    "point;x;y;z;image;px;py\nA;1;2;3;a.jpg;4;5\nA;1;2;3;b c.jpg;6;7.5\n",
    "WGS84 UTM 32N\n500010.5 5000020.25 312 100.5 200 a.jpg P1\n500010 5000020 nan 1 2 b.jpg\n",
    "EPSG:4326\na.jpg -91.9942 46.8425 198.6 0 0 0 0.03\nb.jpg 7 45\n",
)
TURN = "0.8 0.6 0\n-0.6 0.8 0\n0 0 1"
CAMERA = f"{K}\n0 0 0\n{TURN}\n1.5 -2 0.25\n640 480\n"


def pairs(rng, folder) -> str:
    path = folder / "pairs.txt"
    path.write_bytes(damaged_text(PAIRS, rng))
    how, found = outcome(lambda: read_pairs(path, NAMES), "--pairs")
    if how == "read":
        assert found and found == sorted(set(found))
        assert all(a < b and {a, b} <= set(NAMES) for a, b in found)
    return how


def checked(text: str) -> str:
    def parse():
        found = parse_cameras(text)
        check_fits(found, {"a.jpg": SIZE})
        return found, found.camera(SIZE)

    how, found = outcome(parse, "--intrinsics")
    if how == "read":
        known, camera = found
        assert np.isfinite(known.params).all() and camera.has_prior_focal_length
        assert len(camera.params) == len(known.params)
    return how


def intrinsics_file(rng, folder) -> str:
    path = folder / "K.txt"
    path.write_bytes(damaged_text(K, rng))
    return checked(str(path))


def intrinsics_option(rng, folder) -> str:
    spec = MODELS[rng.integers(len(MODELS))].replace(":", " : ").replace(",", " , ")
    return checked(damaged_text(spec, rng).decode(errors="surrogateescape").replace(" ", ""))


def camera_file(rng, folder) -> str:
    path = folder / "a.jpg.camera"
    path.write_bytes(damaged_text(CAMERA, rng))
    how, found = outcome(lambda: read_poses(folder), path)
    if how == "read":
        pose = found["a.jpg"]
        assert np.isfinite(pose.centre).all()
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=2e-3)
    return how


def aachen_file(rng, folder) -> str:
    """A list of cameras, of pairs or of subsets, or a model in NVM format."""
    kind = rng.integers(4)
    name = ("a_intrinsics.txt", AACHEN_PAIRS, "subsets.txt", "a.nvm")[kind]
    path = folder / name
    path.write_bytes(damaged_text((CAMERAS, NIGHTS, SUBSETS, NVM)[kind], rng))
    read = (
        lambda: read_cameras(folder),
        lambda: read_subsets(folder, None),
        lambda: read_subsets(folder, path),
        lambda: read_nvm(path),
    )[kind]
    how, found = outcome(read, path)
    path.unlink()  # it must not be in the next case
    if how == "read" and kind == 3:
        for pose in found.values():
            assert np.isfinite(pose.centre).all()
            np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-6)
    elif how == "read" and kind:
        assert found and all(subset.day for subset in found)
    return how


def position_table(rng, folder) -> str:
    path = folder / "positions.txt"
    path.write_bytes(damaged_text(TABLES[rng.integers(len(TABLES))], rng))
    how, found = outcome(lambda: read_position_table(path), "--georeference")
    if how == "read":
        given = [*found.positions.values(), *(point.position for point in found.points)]
        assert all(np.isfinite([at.x, at.y, at.z or 0, at.deviation or 1]).all() for at in given)
        assert all(np.isfinite([s.x, s.y]).all() for point in found.points for s in point.seen)
    return how


def text(rng, folder) -> str:
    """One of the six kinds."""
    kinds = [
        pairs,
        intrinsics_file,
        intrinsics_option,
        camera_file,
        aachen_file,
        position_table,
    ]
    return kinds[rng.integers(len(kinds))](rng, folder)


def test_a_damaged_text_is_read_or_refused_by_name(tmp_path, share, least):
    found = run_cases("test_fuzz_texts", "text", round(800 * share), tmp_path)
    assert found["read"] > 80 * least and found["refused"] > 200 * least
