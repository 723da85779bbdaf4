"""hloc's files: written as its readers look for them, and read back."""

import h5py
import numpy as np
import pytest
from foreign_model import NAMES, camera, exact_model, write_run

from jaxsfm.colmap.formats.database import read_database
from jaxsfm.colmap.formats.hloc import FEATURES, MATCHES, PAIRS, read_hloc, write_hloc
from jaxsfm.colmap.formats.tables import Tables
from jaxsfm.errors import UserError


@pytest.fixture(scope="module")
def tables(tmp_path_factory) -> Tables:
    run = write_run(tmp_path_factory.mktemp("run"), exact_model([camera("PINHOLE")]))
    return read_database(run / "database.db", where="run")


@pytest.fixture
def written(tmp_path, tables):
    write_hloc(tmp_path, tables, tables.matches, dict.fromkeys(tables.sizes, 1.5))
    return tmp_path


def read(folder, names=NAMES):
    return read_hloc(folder / FEATURES, folder / MATCHES, names, where="--with-hloc")


def hloc_pair(name0, name1):
    return "/".join((name0.replace("/", "-"), name1.replace("/", "-")))


def test_hlocs_readers_find_every_key(written, tables):
    """`get_keypoints`, `find_pair`, `get_matches`, `parse_retrieval` and FeaturePairsDataset."""
    with h5py.File(written / FEATURES, libver="latest") as file:
        for name, size in tables.sizes.items():
            keypoints = file[name]["keypoints"]
            assert keypoints.attrs["uncertainty"] == 1.5
            values = keypoints.__array__()
            assert values.dtype == np.float32 and np.array_equal(values, tables.keypoints[name])
            assert tuple(file[name]["image_size"]) == size
    lines = (written / PAIRS).read_text().splitlines()
    pairs = [tuple(line.split()) for line in lines]
    assert pairs == sorted(tables.matches)
    with h5py.File(written / MATCHES, libver="latest") as file:
        for pair in pairs:
            group = file[hloc_pair(*pair)]
            second, scores = group["matches0"].__array__(), group["matching_scores0"].__array__()
            assert second.dtype == np.int32 and len(second) == len(tables.keypoints[pair[0]])
            first = np.where(second != -1)[0]
            found = np.stack([first, second[first]], -1)
            rows = tables.matches[pair]
            assert np.array_equal(found, rows[np.argsort(rows[:, 0])])
            assert ((scores > 0.5) == (second != -1)).all()


def test_hlocs_keypoints_half_a_pixel_on_are_colmaps(written, tables, tmp_path):
    """hloc's import_features adds 0.5."""
    model = exact_model([camera("PINHOLE")])
    seen = {image.name: [p.xy for p in image.points2D] for image in model.images.values()}
    with h5py.File(written / FEATURES) as file:
        for name in NAMES:
            for xy in file[name]["keypoints"][:] + 0.5:
                assert np.abs(np.asarray(seen[name]) - xy).sum(1).min() < 1e-3


def test_what_is_written_is_read_back(written, tables):
    back = read(written)
    assert back.sizes == tables.sizes
    for name in NAMES:
        assert np.array_equal(back.keypoints[name], tables.keypoints[name])
    assert back.matches.keys() == tables.matches.keys()
    for pair, rows in back.matches.items():
        assert set(map(tuple, rows)) == set(map(tuple, tables.matches[pair]))


def test_a_pair_in_the_other_order_and_in_the_older_layout_is_read_alike(written, tables):
    pair = "sub/b.jpg", "z/sub/d.jpg"
    straight = read(written).matches[pair]
    second = np.full(len(tables.keypoints[pair[1]]), -1, np.int16)
    second[straight[:, 1]] = straight[:, 0]
    for key in ("z-sub-d.jpg/sub-b.jpg", "z-sub-d.jpg_sub-b.jpg"):
        with h5py.File(written / MATCHES, "w") as file:
            file[f"{key}/matches0"] = second
        found = read(written).matches
        assert list(found) == [pair]
        assert set(map(tuple, found[pair])) == set(map(tuple, straight))


def test_half_precision_and_more_columns_are_read(written):
    with h5py.File(written / FEATURES, "a") as file:
        xy = file["a.jpg/keypoints"][:]
        del file["a.jpg/keypoints"]
        file["a.jpg/keypoints"] = np.c_[xy, xy].astype(np.float16)
    assert np.allclose(read(written).keypoints["a.jpg"], xy, atol=0.5)


def test_other_images_in_the_files_are_not_looked_at(written):
    back = read(written, NAMES[:3])
    assert sorted(back.keypoints) == sorted(NAMES[:3])
    assert len(back.matches) == 3


DAMAGE = {
    "an index too large": (MATCHES, "a.jpg/sub-b.jpg/matches0", lambda v: v * 0 + 1000),
    "a negative index": (MATCHES, "a.jpg/sub-b.jpg/matches0", lambda v: v * 0 - 2),
    "too few matches": (MATCHES, "a.jpg/sub-b.jpg/matches0", lambda v: v[1:]),
    "matches as floats": (MATCHES, "a.jpg/sub-b.jpg/matches0", lambda v: v.astype(float)),
    "int16": (MATCHES, "a.jpg/sub-b.jpg/matches0", lambda v: (v * 0 - 30000).astype(np.int16)),
    "a keypoint at infinity": (FEATURES, "a.jpg/keypoints", lambda v: v + np.inf),
    "one column": (FEATURES, "a.jpg/keypoints", lambda v: v[:, :1]),
    "texts": (FEATURES, "a.jpg/keypoints", lambda v: [b"x"]),
    "a size of three": (FEATURES, "a.jpg/image_size", lambda v: [1, 2, 3]),
}


@pytest.mark.parametrize("damage", list(DAMAGE))
def test_inconsistent_files_are_refused_by_file_and_image(written, damage):
    name, key, change = DAMAGE[damage]
    with h5py.File(written / name, "a") as file:
        value = change(file[key][:])
        del file[key]
        file[key] = value
    with pytest.raises(UserError, match=rf"--with-hloc .*{name}: a\.jpg"):
        read(written)


def test_an_overflow_of_int16_is_called_so(written):
    with h5py.File(written / MATCHES, "a") as file:
        value = file["a.jpg/sub-b.jpg/matches0"][:].astype(np.int16)
        value[5] = -32000
        del file["a.jpg/sub-b.jpg/matches0"]
        file["a.jpg/sub-b.jpg/matches0"] = value
    with pytest.raises(UserError, match="int16 and has overflowed"):
        read(written)


@pytest.mark.parametrize(
    ("names", "message"),
    [(["a b.jpg"], "blank"), (["a\nb.jpg"], "blank"), (["a/b.jpg", "a-b.jpg"], "one name")],
)
def test_names_that_hloc_cannot_tell_apart_are_refused(tmp_path, names, message):
    tables = Tables(dict.fromkeys(names, (100, 100)), {}, {}, {}, {})
    with pytest.raises(UserError, match=f"--to hloc: .*{message}"):
        write_hloc(tmp_path, tables, {}, dict.fromkeys(names, 1.0))


def test_missing_files_are_named(tmp_path, written):
    with pytest.raises(UserError, match="nothing.h5: no such file"):
        read_hloc(written / FEATURES, tmp_path / "nothing.h5", NAMES, where="--with-hloc")
