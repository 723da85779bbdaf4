"""`bench warps`: relocalization rules on views of photos, under known homographies.

Each photo is seen through pairs of random homographies, under other lights and at synthetic nights
(`jaxsfm.core.views`, as in training). Cells of the two views are paired as descriptors would match
them, that is, within some pixels of the right place. The figure is the share of these pairs whose
keypoints lie within 1 and 3 pixels of each other.
"""

import functools
from collections.abc import Iterator, Sequence

import jax

from jaxsfm.bench.figures import BenchFigures, Cells, Spread, collect, spread, table
from jaxsfm.bench.options import WarpsOptions
from jaxsfm.errors import UserError
from jaxsfm.io.weights import chosen_weights
from jaxsfm.matching.pipeline import open_images
from jaxsfm.training.objective import mean_shares, shares, warped_examples
from jaxsfm.training.photos import Crops

METHODS = ("norm", "learned")
VIEW, CROP, BATCH, BATCHES = 192, 400, 8, 8
"""Sides of a view and of the crop that it is made of, pixels; pairs of views in a batch; batches of
a seed."""


WarpsRow = dict[str, dict[str, float]]
"""The shares of one seed, by method."""
WarpsSummary = dict[str, dict[str, Spread]]
"""The spread of each share over the seeds, by method."""


def bench_warps(options: WarpsOptions) -> BenchFigures[WarpsRow, WarpsSummary]:
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

    def rows() -> Iterator[WarpsRow]:
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

    print(f"synthetic: {BATCHES * BATCH} pairs of views of {len(images)} photos for each seed")
    return collect("warps", rows(), summary, cells, options)


def summary(rows: Sequence[WarpsRow]) -> WarpsSummary:
    """The spread of each share over the seeds, by method."""
    return {
        method: {name: spread(row[method][name] for row in rows) for name in shares_of}
        for method, shares_of in (rows[0] if rows else {}).items()
    }


def cells(row: WarpsRow) -> Cells:
    """The shares of one seed within 1 and 3 pixels."""
    return {
        method: f"{found['within_1']:.4f} {found['within_3']:.4f}" for method, found in row.items()
    }


def table_lines(result: BenchFigures[WarpsRow, WarpsSummary]) -> list[str]:
    """The table: shares within 1 and 3 pixels, and the learned rule's over the norm rule's."""
    rules = result["summary"]
    columns = {"within_1": "within 1 px", "within_3": "within 3 px"}
    rows = [
        {"rule (synthetic)": method}
        | {
            f"{title} (least, largest)": f"{row[name]['mean']:.4f} "
            f"({row[name]['min']:.4f}, {row[name]['max']:.4f})"
            for name, title in columns.items()
        }
        for method, row in rules.items()
    ]
    lines = table(rows, names=1)
    if rules.keys() >= set(METHODS):
        ratios = [
            f"{rules['learned'][name]['mean'] / max(rules['norm'][name]['mean'], 1e-9):.2f} {title}"
            for name, title in columns.items()
        ]
        lines.append(f"learned / norm: {', '.join(ratios)}")
    return lines
