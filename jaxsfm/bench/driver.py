"""What one process, the driver, does for many photos: its time and memory, without any network.

`python -m jaxsfm.bench.driver --photos 1000,10000,100000` takes the matches of a simulated street
(`jaxsfm.bench.simulated`) as if workers had computed them, and runs what the driver of a run does
with them: it chooses similar photos, puts the pairs in order, keeps and reads the matches, writes
COLMAP's database, verifies the pairs, and decides which pairs to trust. Each number of photos is
measured in a process of its own, whose largest memory is reported.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxsfm.bench.figures import write_json
from jaxsfm.bench.memory import peak_bytes
from jaxsfm.bench.simulated import SimulatedStreet
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.database import write_database
from jaxsfm.colmap.given_cameras import parse_intrinsics
from jaxsfm.colmap.two_views import VerificationOptions, read_two_views, verify
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
