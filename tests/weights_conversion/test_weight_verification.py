"""Verification accepts a right conversion and notices whatever has been exchanged."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imitations import SMALL, WRITERS, netvlad, random_layers, torchvision_names
from scipy.signal import convolve2d, correlate2d

from jaxsfm.core.vgg import LAYERS, VGG16, preprocess
from jaxsfm.io.weight_files import read_converted
from jaxsfm.io.weights import TORCHVISION, load_weights
from jaxsfm.weights_conversion.convert import read_source, write_converted
from jaxsfm.weights_conversion.source import Convention, Source
from jaxsfm.weights_conversion.torchvision import CONVENTION
from jaxsfm.weights_conversion.verify import (
    LIMIT,
    agrees,
    compare,
    layer_maps,
    noise_image,
    table_lines,
)

SIZE = (33, 42)
"""The number of rows is odd, so the last one is not pooled."""


def rows_of(source, converted):
    return compare(source, converted, size=SIZE, shapes=SMALL)


def converted(source, path):
    write_converted(source, path / "out.safetensors")
    return path / "out.safetensors"


@pytest.mark.parametrize("name", WRITERS)
def test_a_right_conversion_agrees_in_every_layer(sources, tmp_path, name):
    source = sources[name]
    rows = rows_of(source, converted(source, tmp_path))
    assert [row.name for row in rows] == [
        "conv1_1", "conv1_2", "pool1", "conv2_1", "conv2_2", "pool2", "conv3_1", "conv3_2",
        "conv3_3", "pool3", "conv4_1", "conv4_2", "conv4_3", "pool4", "conv5_1", "conv5_2",
        "conv5_3", "pool5",
    ]  # fmt: skip
    assert agrees(rows) and max(row.difference for row in rows) < LIMIT / 3
    assert table_lines(rows)[-1].startswith("agree: ")


def test_netvlads_head_is_compared_too(layers, small_head, tmp_path):
    rng = np.random.default_rng(0)
    shapes = {"assignment": (32, 4), "minus_centres": (32, 4), "whitening": (128, 8), "bias": (8,)}
    head = {k: rng.normal(size=shape).astype(np.float32) for k, shape in shapes.items()}
    source = read_source(netvlad(tmp_path, layers, head), shapes=SMALL)
    file = converted(source, tmp_path)
    assert [r.name for r in rows_of(source, file)[18:]] == list(source.extras)
    assert agrees(rows_of(source, file))
    turned = {**source.extras, "netvlad.centres": -source.extras["netvlad.centres"]}
    assert not agrees(rows_of(dataclasses.replace(source, extras=turned), file))


def changed(source: Source, **convention) -> Source:
    """A source that is converted as if it had another convention."""
    return dataclasses.replace(source, convention=source.convention._replace(**convention))


def _exchanged(source: Source) -> Source:
    layers = {**source.layers, "conv4_2": source.layers["conv4_3"]}
    return dataclasses.replace(source, layers={**layers, "conv4_3": source.layers["conv4_2"]})


def _transposed(source: Source) -> Source:
    kernel, bias = source.layers["conv3_2"]
    swapped = kernel.swapaxes(*(0, 1) if source.convention.layout == "HWIO" else (2, 3))
    return dataclasses.replace(source, layers={**source.layers, "conv3_2": (swapped, bias)})


def _other_mean(source: Source) -> Source:
    mean = tuple(reversed(source.preprocessing.mean))
    return dataclasses.replace(source, preprocessing=source.preprocessing._replace(mean=mean))


MISTAKES = {
    "channel order": (lambda s: changed(s, bgr=not s.convention.bgr), "conv1_1"),
    "180 degrees": (lambda s: changed(s, convolution=not s.convention.convolution), "conv1_1"),
    "layers exchanged": (_exchanged, "conv4_2"),
    "rows and columns": (_transposed, "conv3_2"),
    "mean": (_other_mean, "conv1_1"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("name", ["torchvision_zip", "keras_theano", "keras_3", "matconvnet"])
def test_a_wrong_conversion_differs_from_the_layer_on(sources, tmp_path, name, mistake):
    make, first = MISTAKES[mistake]
    source = sources[name]
    rows = rows_of(source, converted(make(source), tmp_path))
    wrong = [row.name for row in rows if row.difference > LIMIT]
    names = [row.name for row in rows]
    assert wrong and wrong[0] == first and wrong == names[names.index(first) :]
    assert min(row.difference for row in rows if row.name in wrong) > 100 * LIMIT
    assert not agrees(rows) and table_lines(rows)[-1].startswith("DIFFER")


@pytest.mark.parametrize("convolution", [False, True])
@pytest.mark.parametrize("layout", ["HWIO", "OIHW"])
@pytest.mark.parametrize("bgr", [False, True])
def test_the_independent_network_is_what_scipy_computes(layout, convolution, bgr):
    (kernel, bias), rgb = random_layers(seed=7)["conv1_1"], noise_image(SIZE)
    stored = kernel if layout == "HWIO" else kernel.transpose(3, 2, 0, 1)
    source = Source(
        family="keras",
        path=None,  # pyright: ignore[reportArgumentType]
        sha256="",
        layers={"conv1_1": (stored, bias)},
        convention=Convention(layout, bgr, convolution),
        preprocessing=TORCHVISION,
    )
    (_, found), *_ = layer_maps(source, rgb)
    image = rgb[..., ::-1] if bgr else rgb
    x = (image / 255.0 - np.asarray(TORCHVISION.mean)) / np.asarray(TORCHVISION.std)
    apply = convolve2d if convolution else correlate2d
    for k in range(len(bias)):
        planes = [apply(x[..., c], kernel[:, :, c, k].astype(float), "same") for c in range(3)]
        np.testing.assert_allclose(found[..., k], sum(planes) + bias[k], atol=1e-12)


@pytest.mark.slow
def test_the_installed_weights_through_a_file_are_the_installed_weights(tmp_path):
    import safetensors.numpy

    installed = load_weights()
    tree = installed.params["params"]
    state = torchvision_names({n: (tree[n]["kernel"], tree[n]["bias"]) for n in LAYERS})
    (tmp_path / "vgg16.safetensors").write_bytes(safetensors.numpy.save(state))
    source = read_source(tmp_path / "vgg16.safetensors")
    assert source.convention == CONVENTION
    file = converted(source, tmp_path)
    loaded = load_weights(file)
    assert jax.tree.all(jax.tree.map(np.array_equal, loaded.params, installed.params))
    assert loaded.preprocessing == installed.preprocessing and loaded.walked == installed.walked
    # The whole network gives the maps that verification compares.
    rgb = noise_image((32, 48))
    images = preprocess(jnp.asarray(rgb), loaded.preprocessing)[None]
    pyramid = VGG16().apply(loaded.params, images, jnp.asarray([[32, 48]], jnp.int32))
    theirs = dict(layer_maps(source, rgb))
    for name, ours in pyramid._asdict().items():
        largest = np.abs(theirs[name]).max()
        assert np.abs(np.asarray(ours[0]) - theirs[name]).max() <= LIMIT * largest, name
    assert read_converted(file).about["source"] == "vgg16.safetensors"
