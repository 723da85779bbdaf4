"""Speed of VGG-16 up to pool4 at 1536 x 1024, next to PyTorch and the machine's matrix products."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxsfm.bench.speed import machine
from jaxsfm.bench.speed.timing import Metric, median, ratio, seconds
from jaxsfm.core.types import Levels
from jaxsfm.core.vgg import BLOCKS, LAYERS, VGG16
from jaxsfm.io.libraries import usable_cores
from jaxsfm.io.weights import load_weights

HEIGHT, WIDTH = 1024, 1536
POOL4 = 4
"""The number of blocks up to pool4."""


def flop(height: int, width: int) -> float:
    """The number of multiplications and additions in the convolutions up to pool4."""
    total = 0.0
    for block, widths in enumerate(BLOCKS[:POOL4], start=1):
        cells = (height >> (block - 1)) * (width >> (block - 1))
        for conv in range(1, len(widths) + 1):
            inputs, outputs = LAYERS[f"conv{block}_{conv}"]
            total += 2 * 9 * cells * inputs * outputs
    return total


@jax.jit
def _pool4(params, x):
    size = jnp.asarray([[HEIGHT, WIDTH]], jnp.int32)
    levels = VGG16().apply(params, x, size, method="levels")
    assert isinstance(levels, Levels)
    return levels.pool4


def _torch_pool4(params: dict, image: np.ndarray) -> Callable[[], np.ndarray] | None:
    """The same layers in PyTorch on all cores; None if PyTorch is not installed."""
    try:
        import torch  # pyright: ignore[reportMissingImports] # optional: the extra `bench`
    except ImportError:
        return None
    torch.set_num_threads(usable_cores())
    layers: list[torch.nn.Module] = []
    for block, widths in enumerate(BLOCKS[:POOL4], start=1):
        for conv in range(1, len(widths) + 1):
            name = f"conv{block}_{conv}"
            layer = torch.nn.Conv2d(*LAYERS[name], 3, padding=1)
            values = params["params"][name]
            kernel = np.array(values["kernel"]).transpose(3, 2, 0, 1).copy()
            layer.weight.data = torch.from_numpy(kernel)
            layer.bias.data = torch.from_numpy(np.array(values["bias"]))
            layers += [layer, torch.nn.ReLU(inplace=True)]
        layers.append(torch.nn.MaxPool2d(2))
    network = torch.nn.Sequential(*layers).to(memory_format=torch.channels_last)
    x = torch.from_numpy(image).permute(0, 3, 1, 2).to(memory_format=torch.channels_last)

    def run() -> np.ndarray:
        with torch.inference_mode():
            return network(x).permute(0, 2, 3, 1).numpy()

    return run


def measure() -> Iterator[Metric]:
    """Time, time compared with matrix products and PyTorch, and the difference from PyTorch."""
    params = jax.device_put(load_weights().params)
    rng = np.random.default_rng(0)
    image = rng.normal(size=(1, HEIGHT, WIDTH, 3)).astype(np.float32)
    x = jax.device_put(image)
    torch_run = _torch_pool4(params, image)
    product = machine.matrix_product()
    work = [lambda: _pool4(params, x), product.compute]
    ours, times, *theirs = seconds(*work, *([torch_run] if torch_run else []))
    rate = flop(HEIGHT, WIDTH) / median(ours)
    yield Metric("vgg_pool4.seconds", median(ours), "s", "lower")
    yield Metric("vgg_pool4.rate", rate / 1e9, "GFLOP/s", "higher")
    ideal = [flop(HEIGHT, WIDTH) / product.operations * time for time in times]
    yield ratio("vgg_pool4.share_of_matrix_products", ideal, ours, "higher", 0.2)
    if torch_run is not None:
        yield ratio("vgg_pool4.speed_over_torch", theirs[0], ours, "higher", 0.2)
        expected, got = torch_run(), np.asarray(_pool4(params, x))
        apart = float(np.abs(got - expected).max() / np.abs(expected).max())
        yield Metric("vgg_pool4.apart_from_torch", apart, "of the largest", "lower", 9.0)
