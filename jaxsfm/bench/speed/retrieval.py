"""Measure how many of each photo's best partners a shortlist keeps.

    jaxsfm bench strecha --root DATA/strecha --methods default --out RUNS
    jaxsfm reconstruct DATA/sacre_coeur/mapping --out RUNS/sacre_coeur --refine 0
    python -m jaxsfm.bench.speed.retrieval RUNS --data DATA

A pair is true if more than half of the matches of the exhaustive run lie within 4 pixels of the
epipolar lines of the ground truth. A photo's best partners are the three photos of its true pairs
with the most matches. Each row of the table is a way to describe photos; each column is a set and
the K of `retrieval:K`.
"""

import argparse
import functools
import itertools
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np

import jaxsfm
from jaxsfm.bench.night_matches import CORRECT_PX, epipolar_distance
from jaxsfm.colmap.database import read_matches
from jaxsfm.colmap.poses import CameraPose, read_poses
from jaxsfm.core.blocks import pool
from jaxsfm.core.numerics import unit
from jaxsfm.core.pooling import gem, vlad
from jaxsfm.core.types import Levels
from jaxsfm.core.vgg import VGG16, Preprocessing, preprocess
from jaxsfm.core.vocabulary import fit_vocabulary
from jaxsfm.io.features import padded_size
from jaxsfm.io.images import ImageFile, read_image
from jaxsfm.io.pairs import Pair
from jaxsfm.io.store import Store
from jaxsfm.io.weights import Weights, load_weights
from jaxsfm.matching.global_descriptors import SAMPLE
from jaxsfm.matching.retrieval import describe_photos, nearest_pairs
from jaxsfm.options import Retrieval

SETS = {
    "castle-P19": (4, 6, 8),
    "entry-P10": (3, 4),
    "fountain-P11": (3, 4),
    "Herz-Jesus-P8": (3,),
    "sacre_coeur": (3, 4),
}
BEST = 3
KINDS: tuple[Retrieval, ...] = ("gem", "vlad")
SIZES = (480, 640)
Local = dict[str, np.ndarray]
"""Local descriptors (cells, channels) by image."""


_fit = jax.jit(fit_vocabulary, static_argnames=("words",))
_vlad = jax.jit(vlad)


class Known(NamedTuple):
    """A photo's camera in the ground truth."""

    pose: CameraPose
    matrix: np.ndarray
    """float64 (3, 3)."""


def cameras(data: Path, name: str) -> tuple[Path, dict[str, Known]]:
    """The folder of a set's photos, and their cameras by name."""
    if name == "sacre_coeur":
        folder, found = data / name / "mapping", {}
        for path in sorted((data / name / "ground_truth").glob("*.h5")):
            with h5py.File(path) as file:
                k, r, t = (np.asarray(file[key], np.float64) for key in ("K", "R", "T"))
            image = path.stem.removeprefix("calibration_") + ".jpg"
            found[image] = Known(CameraPose(r, -r.T @ t.reshape(3)), k)
        return folder, found
    folder = data / "strecha" / name
    k = np.loadtxt(folder / "images" / "K.txt")
    return folder / "images", {n: Known(p, k) for n, p in read_poses(folder).items()}


def true_pairs(database: Path, known: dict[str, Known]) -> dict[Pair, int]:
    """The number of matches of every true pair."""
    found = {}
    for a, b in itertools.combinations(sorted(known), 2):
        xy = read_matches(database, (a, b), verified=False)
        if not len(xy[0]):
            continue
        rays = [
            np.c_[at + 0.5, np.ones(len(at))] @ np.linalg.inv(known[name].matrix).T
            for name, at in zip((a, b), xy, strict=True)
        ]
        far = epipolar_distance(rays[0], rays[1], known[a].pose, known[b].pose)
        if np.mean(far * known[b].matrix[0, 0] <= CORRECT_PX) > 0.5:
            found[a, b] = len(far)
    return found


@functools.partial(jax.jit, static_argnames=("of",))
def both(params: dict, image: jax.Array, valid: jax.Array, *, of: Preprocessing) -> list[jax.Array]:
    """pool4, conv5_3 before its rectifier, and pool5."""
    x = preprocess(image, of)[None]
    levels = VGG16().apply(params, x, valid[None], method="levels")
    conv5 = VGG16().apply(params, x, valid[None], method="conv5")
    assert isinstance(levels, Levels) and isinstance(conv5, jax.Array)
    return [levels.pool4[0], conv5[0], pool(conv5, valid[None] // 16)[0]]


def maps(weights: Weights, images: list[ImageFile], size: int) -> dict[str, Local]:
    """Local descriptors of every layer."""
    found: dict[str, Local] = {"pool4": {}, "conv5": {}, "pool5": {}}
    for image in images:
        rgb = read_image(image, max_size=size).rgb
        height, width = rgb.shape[:2]
        padded = np.zeros((*padded_size((width, height)), 3), np.uint8)
        padded[:height, :width] = rgb
        valid = np.asarray([height, width], np.int32)
        each = both(weights.params, padded, valid, of=weights.preprocessing)
        for layer, stride, x in zip(found, (16, 16, 32), each, strict=True):
            cells = np.asarray(x)[: height // stride, : width // stride]
            found[layer][image.name] = cells.reshape(-1, cells.shape[-1])
    return found


def as_in_runs(weights: Weights, images: list[ImageFile], kind: Retrieval) -> Local:
    """The descriptors that `--retrieval` uses."""
    identity = {"version": "", "weights": weights.sha256}
    with tempfile.TemporaryDirectory() as scratch:
        store = Store(Path(scratch), identity)
        return describe_photos(weights, images, kind=kind, store=store).vectors


def by_gem(local: Local, power: float) -> dict[str, np.ndarray]:
    """Descriptors as in `jaxsfm.matching.global_descriptors`, with another exponent."""
    return {name: np.asarray(gem(unit(jnp.asarray(x)), power=power)) for name, x in local.items()}


def by_vlad(local: Local, words: int, seed: int) -> dict[str, np.ndarray]:
    """Descriptors as in `jaxsfm.matching.global_descriptors`, with another vocabulary."""
    units = {name: np.asarray(unit(jnp.asarray(x))) for name, x in local.items()}
    rng = np.random.default_rng(seed)
    parts = [rng.permutation(x)[: SAMPLE // len(units)] for x in units.values()]
    fitted = _fit(jax.random.key(seed), np.concatenate(parts), words=words)
    return {name: np.asarray(_vlad(x, fitted)) for name, x in units.items()}


def ways(found: dict[str, Local]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Every way to describe photos, with its name in the table."""
    for layer in ("pool4", "pool5"):
        for power in (1.0, 3.0):
            yield f"gem {layer} p {power:.0f}", by_gem(found[layer], power)
    for layer in ("pool4", "conv5"):
        for words in (32, 64):
            for seed in (0, 1):
                yield f"vlad {layer} {words} seed {seed}", by_vlad(found[layer], words, seed)


def kept(vectors: dict[str, np.ndarray], truth: dict[Pair, int], k: int) -> str:
    """The photos whose best partners are all kept, the share of partners kept, and the pairs."""
    pairs = set(nearest_pairs(vectors, k))
    all_kept, hits = 0, []
    for name in vectors:
        own = sorted(((n, pair) for pair, n in truth.items() if name in pair), reverse=True)
        own_hits = [pair in pairs for _, pair in own[:BEST]]
        all_kept += all(own_hits)
        hits += own_hits
    return f"{all_kept}/{len(vectors)} {np.mean(hits):.2f} ({len(pairs)})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="How many best partners a shortlist keeps.")
    parser.add_argument("runs", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    args = parser.parse_args()
    weights = load_weights()
    rows: dict[str, list[str]] = {}
    head = []
    for name, ks in SETS.items():
        out = args.runs / name
        out = out / "dense-relocalized" if (out / "dense-relocalized").is_dir() else out
        if not (out / "database.db").is_file():
            print(f"skipped: {name} (no run in {out})")
            continue
        folder, known = cameras(args.data, name)
        images = [image for image in jaxsfm.open_images(folder)[0] if image.name in known]
        truth = true_pairs(out / "database.db", known)
        head += [f"{name} K = {k}" for k in ks]
        ours = {f"--retrieval {kind}": as_in_runs(weights, images, kind) for kind in KINDS}
        for size in SIZES:
            found = maps(weights, images, size)
            ours |= {f"{size} {way}": vectors for way, vectors in ways(found)}
        for way, vectors in ours.items():
            rows.setdefault(way, []).extend(kept(vectors, truth, k) for k in ks)
            print(name, way, *rows[way][-len(ks) :], file=sys.stderr)
    print("| |", " | ".join(head), "|")
    print("|---|" + "---|" * len(head))
    for way, cells in rows.items():
        print(f"| {way} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
