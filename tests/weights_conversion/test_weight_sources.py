"""All formats hold the same network and are converted to the same weights."""

import shutil

import h5py
import numpy as np
import pytest
import safetensors.numpy
import scipy.io
from imitations import (
    SMALL,
    WRITERS,
    cell,
    keras_1,
    keras_theano,
    matconvnet,
    netvlad,
    random_layers,
    torch_zip,
    torchvision_names,
)

from jaxsfm.core.vgg import BLOCKS_19, layers_of
from jaxsfm.errors import UserError
from jaxsfm.io.weight_files import read_converted, read_extras
from jaxsfm.io.weights import TORCHVISION
from jaxsfm.weights_conversion.convert import read_source, write_converted
from jaxsfm.weights_conversion.torchvision import numbered
from jaxsfm.weights_conversion.verify import agrees, compare

DEEP = layers_of(BLOCKS_19)
CAFFE = (1.0, (123.68, 116.779, 103.939), (1.0, 1.0, 1.0))


def same(ours, layers) -> bool:
    return all(
        np.array_equal(ours[name]["kernel"], kernel) and np.array_equal(ours[name]["bias"], bias)
        for name, (kernel, bias) in layers.items()
    )


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_becomes_the_same_rgb_correlation_kernels(
    files, sources, layers, tmp_path, name
):
    source = sources[name]
    family = name.split("_")[0].replace("matconvnet", "caffe")
    assert source.family == family
    out = tmp_path / "out.safetensors"
    write_converted(source, out)
    found = read_converted(out, shapes=SMALL)
    assert same(found.layers, layers) and list(found.layers) == list(SMALL)
    if family == "torchvision":
        assert found.preprocessing == TORCHVISION
    else:
        np.testing.assert_allclose(found.preprocessing[1], CAFFE[1], rtol=1e-6)
        assert found.preprocessing[::2] == CAFFE[::2]
    assert found.family == family and found.about["source"] == files[name].name
    assert found.about["source_sha256"] == source.sha256 and found.about["converter"] == 1


def test_the_same_source_gives_the_same_bytes(sources, tmp_path):
    for name in "ab":
        write_converted(sources["keras_3"], tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_suffix_says_nothing(files, sources, tmp_path):
    for name in ("torchvision_legacy", "torchvision_safetensors", "keras_3", "matconvnet_old"):
        shutil.copyfile(files[name], tmp_path / "weights.bin")
        source = read_source(tmp_path / "weights.bin", shapes=SMALL)
        assert source.family == sources[name].family


def test_kernels_that_may_be_turned_or_not_are_asked_for(layers, tmp_path):
    unnamed = keras_theano(tmp_path, layers).rename(tmp_path / "weights.h5")
    with pytest.raises(UserError, match="--kernels theano"):
        read_source(unnamed, shapes=SMALL)
    turned = read_source(unnamed, shapes=SMALL, kernels="theano").convention
    assert turned.convolution and turned.layout == "OIHW"
    assert not read_source(unnamed, shapes=SMALL, kernels="tensorflow").convention.convolution


def test_kernels_said_to_be_theanos_are_turned(layers, tmp_path):
    source = read_source(keras_1(tmp_path, layers), shapes=SMALL, kernels="theano")
    write_converted(source, tmp_path / "out")
    turned = read_converted(tmp_path / "out", shapes=SMALL).layers["conv2_1"]["kernel"]
    assert np.array_equal(turned, layers["conv2_1"][0][::-1, ::-1])


def test_another_family_or_option_than_the_files_is_refused(files):
    with pytest.raises(UserError, match="--family keras: .*is of the family torchvision"):
        read_source(files["torchvision_zip"], family="keras", shapes=SMALL)
    with pytest.raises(UserError, match="--kernels theano: only Keras"):
        read_source(files["matconvnet"], kernels="theano", shapes=SMALL)


@pytest.fixture
def head() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    shapes = {
        "assignment": (32, 4),
        "minus_centres": (32, 4),
        "whitening": (128, 8),
        "bias": (8,),
    }
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def test_netvlads_head_is_kept_with_centres_that_are_subtracted(layers, head, small_head, tmp_path):
    source = read_source(netvlad(tmp_path, layers, head), shapes=SMALL)
    assert source.family == "netvlad" and source.notes == ()
    write_converted(source, tmp_path / "out")
    assert same(read_converted(tmp_path / "out", shapes=SMALL).layers, layers)
    extras = read_extras(tmp_path / "out")
    assert np.array_equal(extras["netvlad.assignment"], head["assignment"])
    assert np.array_equal(extras["netvlad.centres"], -head["minus_centres"])
    assert np.array_equal(extras["netvlad.whitening"], head["whitening"])
    assert np.array_equal(extras["netvlad.whitening_bias"], head["bias"])


def test_a_head_with_values_that_are_not_finite_is_refused(layers, head, small_head, tmp_path):
    head["whitening"][5, 1] = np.nan
    with pytest.raises(UserError, match="head has values that are not finite"):
        read_source(netvlad(tmp_path, layers, head), shapes=SMALL)


def test_a_mean_image_of_several_colours_is_noted(layers, tmp_path):
    file = matconvnet(tmp_path, layers)
    top = scipy.io.loadmat(file)
    image = np.zeros((2, 2, 3), np.float32)
    image[0, 0] = 8.0
    top["meta"] = {"normalization": {"averageImage": image}}
    scipy.io.savemat(file, {k: v for k, v in top.items() if not k.startswith("_")})
    source = read_source(file, shapes=SMALL)
    assert source.preprocessing.mean == (2.0, 2.0, 2.0) and "several colours" in source.notes[0]


# -- what is refused -------------------------------------------------------------------------------


def test_a_network_of_other_layers_is_refused_by_the_first_that_differs(files, layers, tmp_path):
    with pytest.raises(UserError, match=r"conv1_1 must be .*\(64, 3, 3, 3\); got float32"):
        read_source(files["torchvision_zip"])
    state = torchvision_names(layers)
    changes = {
        "missing": (("features.7.bias", None), "bias of conv2_2 is missing"),
        "shape": (("features.7.weight", np.zeros((8, 8, 1, 1), np.float32)), "got float32 .8, 8"),
        "nan": (("features.0.bias", np.full(4, np.nan, np.float32)), "conv1_1 has values"),
        "inf": (("features.28.weight", state["features.28.weight"] * np.inf), "conv5_3 has"),
    }
    for name, ((key, value), words) in changes.items():
        changed = {k: v for k, v in {**state, key: value}.items() if v is not None}
        path = torch_zip(tmp_path / f"{name}.pth", changed)
        with np.errstate(all="ignore"), pytest.raises(UserError, match=words) as error:
            read_source(path, shapes=SMALL)
        assert str(path) in str(error.value)


def test_safetensors_of_something_else_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    for arrays in ({"a": np.zeros(3)}, {"features.0.weight": np.zeros((4, 3, 3, 3), np.int32)}):
        path.write_bytes(safetensors.numpy.save(arrays))
        with pytest.raises(UserError, match="a.safetensors: the kernel of conv1_1"):
            read_source(path, shapes=SMALL)


def test_a_matlab_file_without_a_network_or_mean_is_refused(layers, tmp_path):
    path = tmp_path / "a.mat"
    for top, words in (
        ({"x": 1}, "not a network of MatConvNet"),
        ({"layers": np.zeros(3)}, "not a network of MatConvNet"),
        ({"net": {"layers": cell([1, 2]), "meta": {}}}, "mean colour, is missing"),
        ({"layers": cell([{"name": "conv1_1"}])}, "mean colour, is missing"),
    ):
        scipy.io.savemat(path, top)
        with pytest.raises(UserError, match=words):
            read_source(path, shapes=SMALL)


def test_version_73_names_the_way_out(tmp_path):
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as h5:
        h5["layers"] = np.zeros(3)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128))
    with pytest.raises(UserError, match="version 7.3; save it in MATLAB with '-v7'"):
        read_source(path)


def test_hdf5_files_do_not_lead_to_other_files(layers, tmp_path):
    secret = tmp_path / "secret.h5"
    good = keras_1(tmp_path, layers)
    shutil.copyfile(good, secret)
    path = tmp_path / "linked.h5"
    name = "block2_conv1/block2_conv1_W_1:0"
    shutil.copyfile(good, path)
    with h5py.File(path, "a") as h5:
        del h5[name]
        h5[name] = h5py.ExternalLink(secret, name)
    with pytest.raises(UserError, match="kernel of conv2_1 is missing"):
        read_source(path, shapes=SMALL)
    shape = layers["conv2_1"][0].shape
    for kind in ("virtual", "external"):
        shutil.copyfile(good, path)
        with h5py.File(path, "a") as h5:
            del h5[name]
            if kind == "virtual":
                layout = h5py.VirtualLayout(shape, np.float32)
                layout[:] = h5py.VirtualSource(str(secret), name, shape)
                h5.create_virtual_dataset(name, layout)
            else:
                size = 4 * int(np.prod(shape))
                h5.create_dataset(name, shape, np.float32, external=[(str(secret), 0, size)])
        with pytest.raises(UserError, match="is in another file"):
            read_source(path, shapes=SMALL)


def test_a_huge_dataset_is_refused_before_it_is_read(layers, tmp_path):
    path = keras_1(tmp_path, layers)
    with h5py.File(path, "a") as h5:
        del h5["block2_conv1"]["block2_conv1_W_1:0"]
        h5.create_dataset("block2_conv1/x", (3, 3, 1 << 20, 1 << 20), np.float32, chunks=(3,) * 4)
    with pytest.raises(UserError, match="is not a layer of VGG-16"):
        read_source(path, shapes=SMALL)


def test_a_layer_that_is_there_twice_is_refused(layers, tmp_path):
    path = keras_1(tmp_path, layers)
    with h5py.File(path, "a") as h5:
        h5["other/block1_conv1/kernel"] = np.zeros((3, 3, 3, 4), np.float32)
    with pytest.raises(UserError, match="conv1_1.kernel is in the file more than once"):
        read_source(path, shapes=SMALL)


def test_an_optimizers_moments_are_not_weights(layers, tmp_path):
    path = keras_1(tmp_path, layers)
    with h5py.File(path, "a") as h5:
        h5["optimizer_weights/Adam/block1_conv1/kernel/m:0"] = np.zeros((3, 3, 3, 4), np.float32)
    write_converted(read_source(path, shapes=SMALL), tmp_path / "out")
    assert same(read_converted(tmp_path / "out", shapes=SMALL).layers, layers)


def test_a_converted_file_is_no_source_and_no_source_is_overwritten(files, sources, tmp_path):
    source = sources["keras_1"]
    out = tmp_path / "a.safetensors"
    write_converted(source, out)
    with pytest.raises(UserError, match="the file is converted already"):
        read_source(out, shapes=SMALL)
    before = files["keras_1"].read_bytes()
    with pytest.raises(UserError, match="this is the file to convert"):
        write_converted(source, files["keras_1"])
    assert files["keras_1"].read_bytes() == before


@pytest.mark.slow
def test_vgg19_of_torchvision_is_known_by_its_last_layer(sources, tmp_path):
    """VGG-19 has three more convolutions, so its modules have other numbers than VGG-16's."""
    layers = random_layers({n: (3 if i == 3 else i // 16, o // 16) for n, (i, o) in DEEP.items()})
    tensors = {}
    for module, layer in numbered(BLOCKS_19).items():
        kernel, bias = layers[layer]
        tensors[f"{module}.weight"] = np.ascontiguousarray(kernel.transpose(3, 2, 0, 1))
        tensors[f"{module}.bias"] = bias
    assert "features.34.weight" in tensors and "features.16.weight" in tensors
    safetensors.numpy.save_file(tensors, tmp_path / "vgg19.safetensors")
    small = {name: (kernel.shape[2], kernel.shape[3]) for name, (kernel, _) in layers.items()}
    source = read_source(tmp_path / "vgg19.safetensors", shapes=small)
    assert source.architecture == "vgg19"
    write_converted(source, tmp_path / "out")
    found = read_converted(tmp_path / "out", shapes=small)
    assert found.architecture == "vgg19" and same(found.layers, layers)
    rows = compare(source, tmp_path / "out", size=(32, 32), shapes=small)
    assert agrees(rows) and len(rows) == 16 + 5
    with pytest.raises(UserError, match="holds a vgg19, but .* a vgg16"):
        compare(sources["torchvision_zip"], tmp_path / "out", shapes=small)
    del tensors["features.34.weight"]
    safetensors.numpy.save_file(tensors, tmp_path / "cut.safetensors")
    with pytest.raises(UserError, match="missing|must be"):
        read_source(tmp_path / "cut.safetensors", shapes=SMALL)
