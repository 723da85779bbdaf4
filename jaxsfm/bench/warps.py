"""`bench warps`: relocalization rules on views of photos, under known homographies.

Each photo is seen through pairs of random homographies, under other lights and at synthetic nights
(`jaxsfm.core.views`, as in training). Cells of the two views are paired as descriptors would match
them, that is, within some pixels of the right place. The figure is the share of these pairs whose
keypoints lie within 1 and 3 pixels of each other.
"""

import functools
from collections.abc import Iterator
from typing import TypedDict

import jax

from jaxsfm.bench.figures import Spread, collect, spread
from jaxsfm.bench.options import WarpsOptions
from jaxsfm.errors import UserError
from jaxsfm.io.versions import package_versions
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.training.objective import mean_shares, shares, warped_examples
from jaxsfm.training.photos import Crops

METHODS = ("norm", "learned")
VIEW, CROP, BATCH, BATCHES = 192, 400, 8, 8
"""Sides of a view and of the crop that it is made of, pixels; pairs of views in a batch; batches of
a seed."""


class WarpsFigures(TypedDict):
    """The figures of the benchmark, as JSON."""

    benchmark: str
    synthetic: bool
    versions: dict[str, str]
    photos: int
    seeds: int
    pairs_of_views: int
    """The number of pairs for each seed."""
    methods: dict[str, dict[str, Spread]]
    """The spread of each share over the seeds, by method."""


def bench_warps(options: WarpsOptions) -> WarpsFigures:
    """Measure both rules on the same views."""
    methods = options.chosen_methods(METHODS)
    images, _ = open_images(options.root)
    if not images:
        raise UserError(f"--root {options.root}: no usable images")
    weights = chosen_weights(options.network)
    learned = weights.learned.params if "learned" in methods else None
    warp = functools.partial(
        warped_examples, weights.params, preprocessing=weights.preprocessing, size=VIEW
    )

    def rows() -> Iterator[dict[str, dict[str, float]]]:
        """For each seed, the shares of each method."""
        for seed in range(options.seeds):
            crops, found = Crops(images, side=CROP, seed=seed), {method: [] for method in methods}
            for step in range(BATCHES):
                key = jax.random.fold_in(jax.random.key(seed), step)
                examples = warp(key, crops.draw(step, BATCH))
                for method in methods:
                    scores = learned if method == "learned" else None
                    found[method].append(jax.device_get(shares(scores, examples)))
            yield {method: mean_shares(found[method]) for method in methods}

    def figures(measured: list[dict[str, dict[str, float]]]) -> WarpsFigures:
        return {
            "benchmark": "warps",
            "synthetic": True,
            "versions": package_versions(),
            "photos": len(images),
            "seeds": options.seeds,
            "pairs_of_views": BATCHES * BATCH,
            "methods": {
                method: {
                    name: spread(row[method][name] for row in measured)
                    for name in measured[0][method]
                }
                for method in methods
            },
        }

    return collect(rows(), figures, line=row_line, json_file=options.json)


def row_line(row: dict[str, dict[str, float]]) -> str:
    """The shares of one seed within 1 and 3 pixels."""
    return ", ".join(
        f"{method} {found['within_1']:.4f} {found['within_3']:.4f}" for method, found in row.items()
    )


def table_lines(result: WarpsFigures) -> list[str]:
    """The table: shares within 1 and 3 pixels, and the learned rule's over the norm rule's."""
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
