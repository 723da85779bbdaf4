"""Speed of larger jobs: many pairs, many pixels, and COLMAP's SIFT."""

import dataclasses
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import jaxsfm
from jaxsfm.bench.speed.timing import Metric, median, ratio, seconds
from jaxsfm.colmap.cameras import Cameras
from jaxsfm.colmap.rootsift import write_rootsift_database
from jaxsfm.colmap.two_views import VerificationOptions
from jaxsfm.config import Config, preset
from jaxsfm.io.images import ImageFile
from jaxsfm.io.weights import load_weights
from jaxsfm.matching.extraction import image_features
from jaxsfm.matching.pair_matching import match_pairs

SMALL = 384
"""Longer side, pixels. It is small so that a thousand pairs take a minute."""
PHOTOS, FEW = 45, 5
"""Numbers of photos: they have 990 and 10 pairs."""


def _photos(data: Path) -> list[ImageFile]:
    folders = sorted((data / "strecha").glob("*/images"))
    return [
        dataclasses.replace(image, name=f"{folder.parent.name}/{image.name}")
        for folder in folders
        for image in jaxsfm.open_images(folder)[0]
    ]


def measure_pairs(data: Path) -> Iterator[Metric]:
    """Seconds per pair among 45 photos, divided by those among five photos.

    The 45 photos are divided into nine groups of five, and all groups are measured, because pairs
    that overlap take less time than others.
    """
    photos = _photos(data)[:PHOTOS]
    if len(photos) < PHOTOS:
        print(f"skipped: scaling (not {PHOTOS} photos in {data}/strecha)")
        return
    config = dataclasses.replace(preset("default"), max_size=SMALL)
    features = jaxsfm.extract(load_weights(), photos, config=config)
    capacities = {name: each.capacity for name, each in features.items()}
    names = [str(name) for name in np.random.default_rng(0).permutation(sorted(features))]

    def per_pair(some: list[str]) -> float:
        pairs = list(itertools.combinations(some, 2))
        start = time.perf_counter()
        for _ in match_pairs(features.__getitem__, capacities, pairs, config=config):
            pass
        return (time.perf_counter() - start) / len(pairs)

    fives = [names[k : k + FEW] for k in range(0, PHOTOS, FEW)]
    per_pair(fives[0])
    # Half of the groups are measured before and half after, in case the machine's speed changes.
    before = [per_pair(five) for five in fives[::2]]
    many = per_pair(names)
    few = before + [per_pair(five) for five in fives[1::2]]
    yield Metric("scaling.pair.seconds", many, "s", "lower")
    yield Metric("scaling.pair.990_over_10", many / float(np.mean(few)), "x", "lower", 0.1)


def measure_pixels(data: Path) -> Iterator[Metric]:
    """Seconds per pixel from 384 x 256 to 2304 x 1536, and the largest over the smallest."""
    config = preset("default")
    weights = load_weights()
    photos = _photos(data)[:1]
    if not photos:
        print(f"skipped: pixels (no photos in {data}/strecha)")
        return

    def work(longer: int) -> Callable[[], object]:
        # A smaller photo is enlarged: only its size matters here.
        sized = dataclasses.replace(config, max_size=longer, enlarge=2.0)
        return lambda: image_features(weights, photos[0], config=sized).dense

    sizes = (384, 768, 1536, 2304)
    turns = seconds(*(work(longer) for longer in sizes), repeat=3)
    costs = [median(times) / (n * n * 2 / 3) for n, times in zip(sizes, turns, strict=True)]
    for longer, cost in zip(sizes, costs, strict=True):
        yield Metric(f"scaling.pixels.{longer}", cost * 1e6, "s per megapixel", "lower")
    yield Metric("scaling.pixels.largest_over_least", max(costs) / min(costs), "x", "lower", 0.2)


def measure_stage(data: Path) -> Iterator[Metric]:
    """Seconds of extraction and all ten pairs of five photos of 1536 x 1024.

    Our methods are compared with COLMAP's SIFT on the CPU, including its verification.
    """
    folder = data / "strecha" / "fountain-P11" / "images"
    photos = jaxsfm.open_images(folder)[0][3:8] if folder.is_dir() else []
    if len(photos) < 5:
        print(f"skipped: stage (no five photos in {folder})")
        return
    weights = load_weights()

    def sift() -> None:
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch) / "database.db"
            write_rootsift_database(database, folder, photos, Cameras(), VerificationOptions())

    def ours(config: Config) -> None:
        features = jaxsfm.extract(weights, photos, config=config)
        jaxsfm.match(features, jaxsfm.exhaustive_pairs(features), config=config)

    configs = {name: preset(name) for name in ("paper", "default")}
    for config in configs.values():
        ours(config)
    times: dict[str, list[float]] = {"sift": [], **{name: [] for name in configs}}
    for _ in range(2):
        for name, own in times.items():
            start = time.perf_counter()
            ours(configs[name]) if name in configs else sift()
            own.append(time.perf_counter() - start)
    yield Metric("stage.sift.seconds", median(times["sift"]), "s", "lower")
    for name in configs:
        yield Metric(f"stage.{name}.seconds", median(times[name]), "s", "lower")
        yield ratio(f"stage.{name}.over_colmap_sift", times[name], times["sift"], "lower", 0.25)
