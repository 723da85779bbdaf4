"""Verification of full-size imitations of every format: the tables of weights_conversion/README.md.

python tests/weights_conversion/full_size.py [ROWS COLUMNS]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

from imitations import WRITERS, Layers, netvlad, random_layers  # noqa: E402

from jaxsfm.core.vgg import LAYERS  # noqa: E402
from jaxsfm.io.weight_files import EXTRAS  # noqa: E402
from jaxsfm.io.weights import load_weights  # noqa: E402
from jaxsfm.weights_conversion.convert import read_source, write_converted  # noqa: E402
from jaxsfm.weights_conversion.verify import SIZE, MapComparison, compare  # noqa: E402


def full_netvlad(path: Path, layers: Layers) -> Path:
    """A random head of NetVLAD's true size is added."""
    rng = np.random.default_rng(1)
    names = ("assignment", "minus_centres", "whitening", "bias")
    head = {
        name: rng.standard_normal(shape, np.float32)
        for name, shape in zip(names, EXTRAS.values(), strict=True)
    }
    return netvlad(path, layers, head)


def verified(writer, layers: Layers, size: tuple[int, int]) -> list[MapComparison]:
    with tempfile.TemporaryDirectory() as scratch:
        source = read_source(writer(Path(scratch), layers))
        target = Path(scratch) / "out.safetensors"
        write_converted(source, target)
        return compare(source, target, size=size)


def main(size: tuple[int, int]) -> None:
    tree = load_weights().params["params"]
    networks = {
        "random": random_layers(LAYERS, seed=5),
        "installed": {name: (tree[name]["kernel"], tree[name]["bias"]) for name in LAYERS},
    }
    writers = {**WRITERS, "netvlad": full_netvlad}
    for network, layers in networks.items():
        columns = {name: verified(writer, layers, size) for name, writer in writers.items()}
        print(f"\n{network} weights, {size[0]} x {size[1]}: largest difference over largest value")
        print(f"{'':10s}" + " ".join(f"{name[-14:]:>14s}" for name in columns))
        for rows in zip(*(column[:18] for column in columns.values()), strict=True):
            cells = " ".join(f"{row.difference:14.2e}" for row in rows)
            print(f"{rows[0].name:10s}{cells}")
        for row in columns["netvlad"][18:]:
            print(f"{row.name}: {row.difference:.2e}")


if __name__ == "__main__":
    main((int(sys.argv[1]), int(sys.argv[2])) if len(sys.argv) > 2 else SIZE)
