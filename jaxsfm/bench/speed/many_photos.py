"""Measure whether a photo costs the same among a hundred photos as among a thousand.

The photos show a rendered street, whose length grows with their number, and are matched with
`--pairs retrieval:K`.

    python -m jaxsfm.bench.speed.many_photos --counts 100 1000 --work FOLDER

The table has the seconds per photo of each stage, and the peak memory until matching ends and until
the run ends.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxsfm.bench.synthetic import TexturedPlane, camera_matrix, look_at, photo_textures, render
from jaxsfm.colmap.poses import CameraPose

SIZE = (240, 180)
STEP, SECTION, REACH = 0.35, 4.0, 9.0
"""In metres: the distance between photos, the length of a section of the street, and how far a
photo sees to either side."""
STAGES = ("retrieval", "extraction", "matching", "mapping")
"""The stages of a run. Mapping includes refinement, because their progress bars appear together."""


def _texture(photos: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """3 x 3 pieces of photographs, each cut, turned and coloured at random, so that all differ."""
    rows = []
    for _ in range(3):
        tiles = []
        for _ in range(3):
            photo = photos[rng.integers(len(photos))]
            side = int(rng.integers(120, 250))
            y, x = (int(rng.integers(n - side)) for n in photo.shape[:2])
            tile = np.rot90(photo[y : y + side, x : x + side], int(rng.integers(4)))
            tile = tile[:, :: rng.choice([-1, 1]), rng.permutation(3)]
            tiles.append(cv2.resize(np.ascontiguousarray(tile), (150, 150)))
        rows.append(np.concatenate(tiles, axis=1))
    return np.concatenate(rows)


def street(length: float, seed: int) -> list[TexturedPlane]:
    """A wall with boards in front of it, section by section; x along the street, y down."""
    rng, photos = np.random.default_rng(seed), photo_textures()
    planes = []
    for x in np.arange(-REACH, length + REACH, SECTION):
        wall, board = _texture(photos, rng), _texture(photos, rng)
        right, down = np.asarray([SECTION, 0, 0]), np.asarray([0, 4.0, 0])
        planes.append(
            TexturedPlane(corner=np.asarray([x, -2, 6.0]), right=right, down=down, texture=wall)
        )
        corner = np.asarray([x + rng.uniform(0, 2), rng.uniform(-1.5, 0), rng.uniform(4.0, 5.2)])
        turned = np.asarray([1.5, 0, rng.uniform(-0.6, 0.6)])
        planes.append(
            TexturedPlane(corner=corner, right=turned, down=np.asarray([0, 1.5, 0]), texture=board)
        )
    return planes


def poses(count: int, seed: int) -> list[CameraPose]:
    """Cameras along the street, at two heights, random distances and random directions."""
    rng = np.random.default_rng(seed + 1)
    found = []
    for k in range(count):
        centre = np.asarray([k * STEP, 0.8 * (k % 2) - 0.4, rng.uniform(-0.8, 0.8)])
        found.append(look_at(centre, centre + [rng.uniform(-1.5, 1.5), rng.uniform(-0.4, 0.4), 5]))
    return found


def write_street(folder: Path, count: int, seed: int = 0) -> None:
    """Write photos to `folder`/images, and K.txt."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    planes = street(count * STEP, seed)
    for k, pose in enumerate(poses(count, seed)):
        near = [p for p in planes if abs(p.corner[0] - pose.centre[0]) < REACH]
        bgr = cv2.cvtColor(render(near, pose, SIZE), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / "images" / f"{k:05d}.jpg"), bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])
    np.savetxt(folder / "K.txt", camera_matrix(SIZE), fmt="%.9g")


class Cost(NamedTuple):
    """What a run costs."""

    photos: int
    registered: int
    pairs: int
    seconds: dict[str, float]
    """Wall time of each stage."""
    busy: dict[str, float]
    """Processor seconds of all threads, by stage; other processes do not count."""
    matched_mb: float
    """Peak memory until mapping begins."""
    peak_mb: float


def _used(pid: int) -> tuple[float, float]:
    """Processor seconds of a process so far, and its peak memory in MB."""
    ticks = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    busy = (int(ticks[11]) + int(ticks[12])) / os.sysconf("SC_CLK_TCK")
    text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(r"VmHWM:\s+(\d+)", text)
    return busy, int(found[1]) / 1024 if found else float("nan")


def measure(scene: Path, out: Path, count: int, options: list[str]) -> Cost:
    """Measure a run in a process of its own."""
    command = [sys.executable, "-m", "jaxsfm", "reconstruct", str(scene / "images")]
    command += ["--out", str(out), "--intrinsics", str(scene / "K.txt"), *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    begun: dict[str, tuple[float, float]] = {}

    def watch() -> None:
        assert process.stderr
        while chunk := process.stderr.read1(4096):  # pyright: ignore[reportAttributeAccessIssue]
            for stage in STAGES:
                if f"{stage}:".encode() in chunk and stage not in begun:
                    begun[stage] = _used(process.pid)
                    print(f"{count} photos, {stage}: begun", *begun[stage], file=sys.stderr)

    reader = threading.Thread(target=watch)
    reader.start()
    _, status, usage = os.wait4(process.pid, 0)
    reader.join()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit status {process.returncode}")
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    ends = [begun[s][0] for s in STAGES[1:]] + [usage.ru_utime + usage.ru_stime]
    busy = {s: end - begun[s][0] for s, end in zip(STAGES, ends, strict=True)}
    wall = report["seconds"]
    wall["mapping"] += wall.get("refinement", 0.0)
    return Cost(
        photos=count,
        registered=report["models"][0]["registered"] if report["models"] else 0,
        pairs=report["pairs"]["tried"],
        seconds=wall,
        busy=busy,
        matched_mb=begun["mapping"][1],
        peak_mb=usage.ru_maxrss / 1024,
    )


def main() -> None:
    """Measure each number of photos and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--nearest", type=int, default=20)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("options", nargs="*", help="of jaxsfm reconstruct, after --")
    given = parser.parse_args()
    print("Per photo, by stage: seconds, and (seconds of all threads)")
    print("photos  registered  pairs  " + "  ".join(f"{s:>15}" for s in STAGES), end="")
    print("  MB until mapping  MB at most")
    for count in given.counts:
        scene = given.work / f"street{count}"
        if not (scene / "K.txt").exists():
            write_street(scene, count)
        options = ["--pairs", f"retrieval:{given.nearest}", *given.options]
        cost = measure(scene, given.work / f"out{count}", count, options)
        each = "  ".join(
            f"{cost.seconds[s] / count:6.3f} ({cost.busy[s] / count:6.3f})" for s in STAGES
        )
        print(f"{count:6d}  {cost.registered:10d}  {cost.pairs:5d}  {each}", end="")
        print(f"  {cost.matched_mb:16.0f}  {cost.peak_mb:10.0f}", flush=True)


if __name__ == "__main__":
    main()
