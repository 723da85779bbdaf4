"""What one process, the driver, does for many photos: its time and memory, without any network.

`python -m jaxsfm.bench.driver --photos 1000,10000,100000` takes the matches of a simulated street
as if workers had computed them, and runs what the driver of a run does with them: it chooses
similar photos, puts the pairs in order, keeps and reads the matches, writes COLMAP's database,
verifies the pairs, and decides which pairs to trust. Each number of photos is measured in a process
of its own, whose largest memory is reported.

The matches of the street are computed from exact points, without pictures or features. The cameras
are those of `jaxsfm.bench.long_street`. Each photo shows some of the points before it, each in a
cell of its own and a pixel or two beside its true place, as relocalized keypoints are. So matches
for any number of photos take little time and memory. Results on it must be called synthetic.
"""

import argparse
import functools
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from jaxsfm.bench.figures import peak_bytes, write_json
from jaxsfm.bench.long_street import DEPTH, SIZE, walk
from jaxsfm.bench.synthetic import camera_matrix
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views, verify
from jaxsfm.core.types import Status
from jaxsfm.io.images import ImageFile
from jaxsfm.io.pairs import Pair, PairResult, make_pair
from jaxsfm.io.store import SavedMatches, Store
from jaxsfm.matching.pair_matching import tile_order
from jaxsfm.matching.retrieval import partner_pairs
from jaxsfm.sfm.view_graph import trusted_pairs

T = TypeVar("T")
LENGTH = 512
"""Of the descriptor of a photo; `vlad` has 4096."""
NEAREST = 20
"""Similar photos of each photo, as with `--pairs auto`."""
CACHED = 500
"""Photos whose features a device holds."""
DENSITY = 5.0
"""Points on a square metre: photos that follow each other have about 100 matches."""
REACH = 12
"""Each photo is matched with so many that follow it. The next one shares too little."""
CELL = 8
"""Pixels of a cell on a side."""
SEEN = 0.8
"""The share of the points before a camera that a photo has keypoints of."""
NOISE_PX = 1.0
"""Of a keypoint, in x and in y."""
HEIGHT = (-3.0, 1.5)
"""From where to where points lie, metres; y is down."""
BLOCK = 5.0
"""Points are drawn for stretches of the street of this length, metres."""
FIRST_BLOCK = 1000
"""Stretches are counted from this many before the beginning, so that no number is negative."""


class SimulatedPhoto(NamedTuple):
    """The keypoints of a photo."""

    points: np.ndarray
    """int64 (n,), ascending: which points they show."""
    cells: np.ndarray
    """int32 (n,): the cell that each lies in."""
    xy: np.ndarray
    """float32 (n, 2), pixels; the centre of the top-left pixel is (0, 0)."""


class SimulatedStreet:
    """Photos along a street. The same numbers give the same street."""

    def __init__(self, photos: int, *, density: float = 40.0, seed: int = 0) -> None:
        """
        Args:
          photos: their number.
          density: points on a square metre.
          seed: of the points, the keypoints and the cameras.
        """
        self.poses = walk(photos, seed=seed)
        self._seed, self._count = seed, round(density * BLOCK * (HEIGHT[1] - HEIGHT[0]))
        self._photo = functools.lru_cache(4 * REACH)(self._make_photo)
        self._block = functools.lru_cache(4 * REACH)(self._make_block)

    def images(self) -> list[ImageFile]:
        """The photos as files, which do not exist."""
        return [
            ImageFile(
                name=self.name(k),
                path=Path(self.name(k)),
                size=SIZE,
                sha256=hashlib.sha256(b"%d %d" % (self._seed, k)).hexdigest(),
            )
            for k in range(len(self.poses))
        ]

    def intrinsics(self) -> str:
        """The camera of all photos, as `--intrinsics` takes it."""
        k = camera_matrix(SIZE)
        return f"PINHOLE:{k[0, 0]},{k[1, 1]},{k[0, 2] + 0.5},{k[1, 2] + 0.5}"

    def name(self, k: int) -> str:
        """The name of a photo."""
        return f"photo{k:06d}.png"

    def pairs(self) -> list[Pair]:
        """All pairs that are matched, in order."""
        count = len(self.poses)
        return sorted(
            make_pair(self.name(i), self.name(j))
            for i in range(count)
            for j in range(i + 1, min(count, i + REACH + 1))
        )

    def photo(self, k: int) -> SimulatedPhoto:
        """The keypoints of a photo."""
        return self._photo(k)

    def point(self, number: int) -> np.ndarray:
        """A point of the street, float64 (3,), metres."""
        stretch, index = divmod(number, self._count)
        return self._block(stretch - FIRST_BLOCK)[index]

    def matches(self, pair: Pair) -> PairResult:
        """The matches of two photos: the points that both show."""
        one, other = (self._photo(int(name[5:11])) for name in pair)
        _, i, j = np.intersect1d(one.points, other.points, assume_unique=True, return_indices=True)
        return PairResult(
            pair=pair,
            cells=np.stack([one.cells[i], other.cells[j]], axis=1),
            keypoints0=one.xy[i],
            keypoints1=other.xy[j],
            plane=np.zeros(len(i), np.int32),
            homographies=np.eye(3)[None],
            num_tentative=len(i),
            num_dropped=0,
            status=Status.VERIFIED,
        )

    def _make_block(self, number: int) -> np.ndarray:
        """The points of a stretch of the street, float64 (n, 3)."""
        rng = np.random.default_rng([self._seed, 1, number + FIRST_BLOCK])
        x = BLOCK * (number + rng.random(self._count))
        y = rng.uniform(*HEIGHT, self._count)
        return np.stack([x, y, DEPTH + rng.uniform(-1, 1, self._count)], axis=1)

    def _make_photo(self, k: int) -> SimulatedPhoto:
        pose, camera = self.poses[k], camera_matrix(SIZE)
        at = int(pose.centre[0] // BLOCK)
        blocks = range(at - 2, at + 3)
        points = np.concatenate([self._block(number) for number in blocks])
        ids = np.concatenate(
            [(number + FIRST_BLOCK) * self._count + np.arange(self._count) for number in blocks]
        )
        x, y, depth = camera @ pose.rotation @ (points - pose.centre).T
        rng = np.random.default_rng([self._seed, 2, k])
        xy = np.stack([x, y], axis=1) / depth[:, None] + rng.normal(0, NOISE_PX, (len(points), 2))
        last = np.asarray(SIZE) - 1
        shown = (depth > 0) & (xy >= 0).all(1) & (xy <= last).all(1) & (rng.random(len(xy)) < SEEN)
        rows = np.flatnonzero(shown)
        columns = -(-SIZE[0] // CELL)
        cells = (xy[rows] // CELL @ [1, columns]).astype(np.int32)
        cells, first = np.unique(cells, return_index=True)
        order = np.argsort(ids[rows[first]])
        rows, cells = rows[first][order], cells[order]
        return SimulatedPhoto(ids[rows], cells, xy[rows].astype(np.float32))


def peak_mb() -> float:
    """The most memory of this process in MB; NaN where the system does not say."""
    return (peak_bytes() or np.nan) / 1e6


def descriptors(photos: int) -> dict[str, np.ndarray]:
    """A vector for each photo; photos near each other on the street have similar ones."""
    rng = np.random.default_rng(0)
    waves, phase = rng.normal(0, 0.3, LENGTH), rng.uniform(0, 2 * np.pi, LENGTH)
    street = SimulatedStreet(0)
    found = {}
    for k in range(photos):
        vector = np.cos(waves * k + phase).astype(np.float32)
        found[street.name(k)] = vector / np.linalg.norm(vector)
    return found


def measure(photos: int, folder: Path) -> dict[str, float]:
    """Seconds of each stage for so many photos, and the largest memory in MB."""
    seconds: dict[str, float] = {}

    def timed(stage: str, work: Callable[[], T]) -> T:
        start = time.process_time()
        result = work()
        seconds[stage] = seconds.get(stage, 0.0) + time.process_time() - start
        print(
            f"{photos} photos: {stage} {seconds[stage]:.1f} s, {peak_mb():.0f} MB", file=sys.stderr
        )
        return result

    vectors = descriptors(photos)
    timed("similar photos", lambda: partner_pairs(vectors, NEAREST))
    vectors.clear()
    street = SimulatedStreet(photos, density=DENSITY)
    images, pairs = street.images(), street.pairs()
    timed("order", lambda: tile_order(pairs, CACHED // 2))
    identity = {"images": {image.name: image.sha256 for image in images}}
    store = Store(folder / "work", identity)

    def keep() -> None:
        for pair in pairs:
            store.save_matches(street.matches(pair))

    timed("keep", keep)
    timed("read", lambda: sum(store.load_matches(pair) is not None for pair in pairs))
    database = folder / "database.db"
    known = parse_intrinsics(street.intrinsics())
    saved = SavedMatches(store, pairs)
    timed("database", lambda: write_database(database, images, saved, Cameras(known=known)))
    timed("verification", lambda: verify(database, VerificationOptions()))
    views = timed("geometries", lambda: read_two_views(database))
    geometries = {pair: view.geometry for pair, view in views.items()}
    verdicts = timed("view graph", lambda: trusted_pairs(geometries))
    counts = {p: geometries[p].num_inliers for p, each in verdicts.items() if each.trusted}
    on_disk = sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())
    return {
        "photos": photos,
        "pairs": len(pairs),
        "trusted pairs": len(counts),
        **seconds,
        "peak_mb": peak_mb(),
        "disk_mb": on_disk / 1e6,
    }


def main(arguments: list[str] | None = None) -> None:
    """Measure some numbers of photos, and print a table."""
    parser = argparse.ArgumentParser(prog="jaxsfm.bench.driver", description=__doc__)
    parser.add_argument("--photos", default="1000,10000", help="numbers, separated by commas")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    given = parser.parse_args(arguments)
    rows = []
    for photos in map(int, given.photos.split(",")):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            target = Path(scratch) / "row.json"
            code = (
                "import pathlib; from jaxsfm.bench.driver import measure; "
                "from jaxsfm.bench.figures import write_json; "
                f"folder = pathlib.Path({scratch!r}); "
                f"write_json(folder / 'row.json', measure({photos}, folder))"
            )
            subprocess.run([sys.executable, "-c", code], check=True)
            rows.append(json.loads(target.read_text(encoding="utf-8")))
        print("\t".join(f"{name} {value:.6g}" for name, value in rows[-1].items()), flush=True)
    if given.json:
        write_json(given.json, {"rows": rows})


if __name__ == "__main__":
    main()
