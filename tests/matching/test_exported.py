"""Exported programs run where jaxsfm is not, and give what it gives."""

import dataclasses
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxsfm.config import Config, preset
from jaxsfm.core.features import extract
from jaxsfm.core.octaves import join_octaves
from jaxsfm.core.pair import match_pair
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.matching.exported import PLATFORMS, export_programs
from jaxsfm.matching.extraction import extraction_settings
from jaxsfm.matching.pair_matching import pair_shape, thresholds

SIZE = (150, 110)
SCRIPT = """
import sys
from pathlib import Path
import numpy as np
from jax import export
folder = Path(sys.argv[1])
extract, match = (
    export.deserialize((folder / name).read_bytes()) for name in ("extract", "match")
)
photos, size = np.load(folder / "photos.npy"), np.load(folder / "size.npy")
features = [extract.call(photo, size) for photo in photos]
found = match.call(np.uint32(3), *features)
assert not [name for name in sys.modules if name.startswith("jaxsfm")]
np.savez(folder / "found.npz", **found, keypoints=features[0]["keypoints"])
"""


def settings_of(name: str) -> Config:
    """A preset for small photos. More than two octaves would only be more programs to compile."""
    config = preset(name)
    return dataclasses.replace(config, max_size=max(SIZE), octaves=min(config.octaves, 2))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "default"])
def test_programs_run_without_jaxsfm_and_give_what_it_gives(weights, photos, tmp_path, name):
    config = settings_of(name)
    programs = export_programs(weights, SIZE, config=config)
    for part, data in programs._asdict().items():
        (tmp_path / part).write_bytes(data)
        assert jax.export.deserialize(bytearray(data)).platforms == PLATFORMS
    padded = np.zeros((2, *padded_size(SIZE), 3), np.uint8)
    padded[0, : SIZE[1], : SIZE[0]] = photos[0][100 : 100 + SIZE[1], 100 : 100 + SIZE[0]]
    padded[1, : SIZE[1], : SIZE[0]] = photos[0][108 : 108 + SIZE[1], 116 : 116 + SIZE[0]]
    size = np.asarray(SIZE[::-1], np.int32)
    np.save(tmp_path / "photos.npy", padded)
    np.save(tmp_path / "size.npy", size)
    subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path)], check=True, cwd=tmp_path)

    capacity = feature_capacity(SIZE)
    settings = extraction_settings(weights, config, capacity.num_coarse)
    features = [
        join_octaves(extract(weights.params, photo, size, settings=settings)) for photo in padded
    ]
    shape = pair_shape(config, capacity)
    expected = match_pair(jax.random.key(3), *features, thresholds(config), shape=shape)
    with np.load(tmp_path / "found.npz") as found:
        np.testing.assert_array_equal(found["keypoints"], features[0].keypoints)
        matched, wanted = (
            {tuple(cell) for cell in np.asarray(each["cells"])[np.asarray(each["plane"]) >= 0]}
            for each in (found, expected._asdict())
        )
    assert len(wanted) > 30 and len(matched ^ wanted) <= 0.02 * len(wanted)


@pytest.mark.optimized
@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "default"])
def test_a_program_for_any_number_of_photos_gives_what_one_photo_gives(weights, photos, name):
    """Bit for bit on a CPU, where the photos of a batch are computed in turn."""
    config = settings_of(name)
    one, many = (
        jax.export.deserialize(
            bytearray(export_programs(weights, SIZE, config=config, batch=batch).extract)
        )
        for batch in (False, True)
    )
    padded = np.zeros((3, *padded_size(SIZE), 3), np.uint8)
    sizes = np.int32([[110, 150], [90, 150], [110, 97]])
    for photo, (rows, columns) in zip(padded, sizes, strict=True):
        photo[:rows, :columns] = photos[0][100 : 100 + rows, 100 : 100 + columns]
    for count in (3, 1):
        found = many.call(padded[:count], sizes[:count])
        for k in range(count):
            for x, y in zip(
                *map(jax.tree.leaves, (found, one.call(padded[k], sizes[k]))), strict=True
            ):
                np.testing.assert_array_equal(x[k], y)
