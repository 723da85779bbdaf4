"""`bench warps`: relocalization rules on views made of any photos, under known homographies.

Every photo is seen through pairs of random homographies and under other lights and synthetic nights
(`jaxsfm.core.views`, as in training). Of the cells of the first view and the cells of the second
that descriptors would match (within some pixels of the right place), the share whose keypoints are
within 1 and 3 px of each other.
"""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from jaxsfm.bench.common import Keep, spread
from jaxsfm.errors import UserError
from jaxsfm.io.versions import package_versions
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.options import USUAL_WEIGHTS, WeightsChoice
from jaxsfm.training.objective import mean_shares, shares, warped_examples
from jaxsfm.training.photos import Crops

METHODS = ("norm", "learned")
VIEW, CROP, BATCH = 192, 400, 8


def bench_warps(
    root: Path,
    *,
    methods: Sequence[str] = METHODS,
    seeds: int = 5,
    batches: int = 8,
    network: WeightsChoice = USUAL_WEIGHTS,
    progress: bool = False,
    keep: Keep = lambda _: None,
) -> dict[str, Any]:
    """Both rules on the same views; plain JSON.

    Args:
      root: folder of photos.
      seeds: sets of views.
      batches: of eight pairs of views, in a set.
      network: the files of its parameters.
    """
    images, _ = open_images(root)
    if not images:
        raise UserError(f"--root {root}: no usable images")
    weights = chosen_weights(network)
    learned = weights.learned.params if "learned" in methods else None
    warp = functools.partial(
        warped_examples, weights.params, preprocessing=weights.preprocessing, size=VIEW
    )
    each: dict[str, list[dict[str, float]]] = {method: [] for method in methods}
    for seed in range(seeds):
        crops, found = Crops(images, side=CROP, seed=seed), {method: [] for method in methods}
        for step in range(batches):
            key = jax.random.fold_in(jax.random.key(seed), step)
            examples = warp(key, crops.draw(step, BATCH))
            for method in methods:
                scores = learned if method == "learned" else None
                found[method].append(jax.device_get(shares(scores, examples)))
        for method in methods:
            each[method].append(mean_shares(found[method]))
        if progress:
            print(f"seed {seed}: " + ", ".join(_line(m, each[m][-1]) for m in methods), flush=True)
        keep(_result(each, len(images), seeds, batches))
    return _result(each, len(images), seeds, batches)


def _line(method: str, found: dict[str, float]) -> str:
    return f"{method} {found['within_1']:.4f} {found['within_3']:.4f}"


def _result(
    each: dict[str, list[dict[str, float]]], photos: int, seeds: int, batches: int
) -> dict[str, Any]:
    rows = {
        method: {name: spread(one[name] for one in found) for name in found[0]}
        for method, found in each.items()
    }
    return {
        "benchmark": "warps",
        "synthetic": True,
        "versions": package_versions(),
        "photos": photos,
        "seeds": seeds,
        "pairs_of_views": batches * BATCH,
        "methods": rows,
    }


def table_lines(result: dict[str, Any]) -> list[str]:
    """Shares within 1 and 3 px, and how much more than the norm rule."""
    lines = [
        f"synthetic: {result['pairs_of_views']} pairs of views of {result['photos']} photos, "
        f"{result['seeds']} seeds",
        f"{'rule':8s} {'within 1 px (least, largest)':>30s} {'within 3 px (least, largest)':>30s}",
    ]
    rows = result["methods"]
    for method, row in rows.items():
        columns = [
            f"{row[name]['mean']:.4f} ({row[name]['min']:.4f}, {row[name]['max']:.4f})"
            for name in ("within_1", "within_3")
        ]
        lines.append(f"{method:8s} " + " ".join(f"{column:>30s}" for column in columns))
    if rows.keys() >= set(METHODS):
        ratios = [
            rows["learned"][name]["mean"] / max(rows["norm"][name]["mean"], 1e-9)
            for name in ("within_1", "within_3")
        ]
        lines.append(f"learned / norm: {ratios[0]:.2f} within 1 px, {ratios[1]:.2f} within 3 px")
    return lines
