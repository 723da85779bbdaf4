"""Write weights in the file format of each framework without the framework."""

import collections
import contextlib
import io
import pickle
import sys
import types
import zipfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
import safetensors.numpy
import scipy.io

from jaxsfm.core.vgg import LAYERS

Layers = dict[str, tuple[np.ndarray, np.ndarray]]
"""The kernel (HWIO, RGB, for correlation) and the bias of each layer."""

SMALL = {
    name: (3 if inputs == 3 else inputs // 16, outputs // 16)
    for name, (inputs, outputs) in LAYERS.items()
}
"""The layers of VGG-16 with a sixteenth of the channels."""
MEAN = (123.68, 116.779, 103.939)
TORCH_INDEX = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


def random_layers(shapes=SMALL, *, seed: int = 0) -> Layers:
    """Random layers, scaled after He et al. so that maps neither vanish nor explode."""
    rng = np.random.default_rng(seed)
    return {
        name: (
            (rng.normal(size=(3, 3, i, o)) * np.sqrt(2 / (9 * i))).astype(np.float32),
            rng.uniform(-0.2, 0.2, o).astype(np.float32),
        )
        for name, (i, o) in shapes.items()
    }


# -- torchvision -----------------------------------------------------------------------------------


def torchvision_names(layers: Layers) -> dict[str, np.ndarray]:
    """The entries of a PyTorch state dict, whose kernels are OIHW."""
    state = {}
    for index, (kernel, bias) in zip(TORCH_INDEX, layers.values(), strict=True):
        state[f"features.{index}.weight"] = np.ascontiguousarray(kernel.transpose(3, 2, 0, 1))
        state[f"features.{index}.bias"] = bias
    state["classifier.0.bias"] = np.zeros(7, np.float32)
    return state


class _Storage:
    def __init__(self, key: str, array: np.ndarray) -> None:
        self.key, self.array = key, array


class _Tensor:
    """An array that is pickled like a PyTorch tensor, or like a parameter of 2017 if `old`."""

    def __init__(self, torch, key: str, array: np.ndarray, old: bool) -> None:
        self.torch, self.storage, self.old = torch, _Storage(key, array), old

    def __reduce__(self):
        shape = self.storage.array.shape
        stride = tuple(s // 4 for s in self.storage.array.strides)
        if self.old:
            return self.torch._utils._rebuild_tensor, (self.storage, 0, shape, stride)
        hooks = collections.OrderedDict()
        return (
            self.torch._utils._rebuild_tensor_v2,
            (self.storage, 0, shape, stride, False, hooks),
        )


class _Parameter:
    def __init__(self, torch, tensor: _Tensor) -> None:
        self.torch, self.tensor = torch, tensor

    def __reduce__(self):
        return self.torch.nn.parameter.Parameter, (self.tensor,), (True, False, None)


@contextlib.contextmanager
def fake_torch() -> Iterator[types.ModuleType]:
    """Modules with the names that PyTorch's pickles hold."""
    modules = {
        name: types.ModuleType(name)
        for name in ("torch", "torch._utils", "torch.nn", "torch.nn.parameter")
    }
    torch = modules["torch"]
    torch._utils, torch.nn = modules["torch._utils"], modules["torch.nn"]
    torch.nn.parameter = modules["torch.nn.parameter"]
    for module, names in (
        ("torch", ["FloatStorage"]),
        ("torch._utils", ["_rebuild_tensor", "_rebuild_tensor_v2"]),
        ("torch.nn.parameter", ["Parameter"]),
    ):
        for name in names:
            setattr(modules[module], name, type(name, (), {"__module__": module}))
    with mock.patch.dict(sys.modules, modules):
        yield torch


class _Pickler(pickle.Pickler):
    def __init__(self, file, torch, *view) -> None:
        super().__init__(file, protocol=2)
        self.torch, self.view = torch, view

    def persistent_id(self, item):
        if not isinstance(item, _Storage):
            return None
        return ("storage", self.torch.FloatStorage, item.key, "cpu", item.array.size, *self.view)


def torch_zip(path: Path, state: dict[str, np.ndarray], *, prefix: str = "archive") -> Path:
    """Write a file as torch.save does since version 1.6."""
    buffer = io.BytesIO()
    with fake_torch() as torch:
        tree = collections.OrderedDict(
            (name, _Tensor(torch, str(k), array, False))
            for k, (name, array) in enumerate(state.items())
        )
        _Pickler(buffer, torch).dump(tree)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{prefix}/data.pkl", buffer.getvalue())
        archive.writestr(f"{prefix}/byteorder", "little")
        for k, array in enumerate(state.values()):
            archive.writestr(f"{prefix}/data/{k}", array.tobytes())
        archive.writestr(f"{prefix}/version", "3\n")
    return path


def torch_legacy(path: Path, state: dict[str, np.ndarray]) -> Path:
    """Write a file as torch.save did in 2017, when state dicts held parameters."""
    system = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"int": 4}}
    with fake_torch() as torch, path.open("wb") as file:
        tree = collections.OrderedDict(
            (name, _Parameter(torch, _Tensor(torch, str(94000 + k), array, True)))
            for k, (name, array) in enumerate(state.items())
        )
        for head in (0x1950A86A20F9469CFC6C, 1001, system):
            pickle.dump(head, file, protocol=2)
        _Pickler(file, torch, None).dump(tree)
        order = {str(94000 + k): array for k, array in enumerate(state.values())}
        keys = sorted(order, reverse=True)
        pickle.dump(keys, file, protocol=2)
        for key in keys:
            file.write(order[key].size.to_bytes(8, "little") + order[key].tobytes())
    return path


def torchvision_zip(path: Path, layers: Layers) -> Path:
    return torch_zip(path / "vgg16-new.pth", torchvision_names(layers))


def torchvision_legacy(path: Path, layers: Layers) -> Path:
    return torch_legacy(path / "vgg16-397923af.pth", torchvision_names(layers))


def torchvision_safetensors(path: Path, layers: Layers) -> Path:
    file = path / "vgg16.safetensors"
    file.write_bytes(safetensors.numpy.save(torchvision_names(layers), {"format": "pt"}))
    return file


# -- Keras: input BGR ------------------------------------------------------------------------------


def _bgr(layers: Layers) -> Layers:
    kernel, bias = layers["conv1_1"]
    return {**layers, "conv1_1": (kernel[:, :, ::-1], bias)}


def _keras_name(layer: str) -> str:
    return f"block{layer[4]}_conv{layer[6]}"


def keras_1(path: Path, layers: Layers) -> Path:
    """vgg16_weights_tf_dim_ordering_tf_kernels.h5, with its classifier."""
    file = path / "vgg16_weights_tf_dim_ordering_tf_kernels.h5"
    with h5py.File(file, "w") as h5:
        h5.attrs["layer_names"] = [_keras_name(n).encode() for n in layers]
        for layer, (kernel, bias) in _bgr(layers).items():
            group = h5.create_group(_keras_name(layer))
            names = [f"{_keras_name(layer)}_{part}_1:0" for part in "Wb"]
            group.attrs["weight_names"] = [name.encode() for name in names]
            group[names[0]], group[names[1]] = kernel, bias
        h5["fc1/fc1_W_1:0"] = np.zeros((8, 4), np.float32)
    return file


def keras_theano(path: Path, layers: Layers) -> Path:
    """vgg16_weights_th_dim_ordering_th_kernels_notop.h5: OIHW, turned by 180 degrees."""
    file = path / "vgg16_weights_th_dim_ordering_th_kernels_notop.h5"
    with h5py.File(file, "w") as h5:
        for layer, (kernel, bias) in _bgr(layers).items():
            group = h5.create_group(_keras_name(layer))
            turned = np.rot90(kernel, 2, axes=(0, 1)).transpose(3, 2, 0, 1)
            group[f"{_keras_name(layer)}_W"], group[f"{_keras_name(layer)}_b"] = turned, bias
    return file


def keras_2(path: Path, layers: Layers, *, backend: str = "tensorflow") -> Path:
    """A whole model of Keras 2; on Theano its kernels are HWIO and turned."""
    file = path / f"model_{backend}.h5"
    with h5py.File(file, "w") as h5:
        h5.attrs["backend"], h5.attrs["keras_version"] = backend.encode(), b"2.3.1"
        for layer, (kernel, bias) in _bgr(layers).items():
            group = h5.create_group(f"model_weights/{_keras_name(layer)}/{_keras_name(layer)}")
            turned = np.rot90(kernel, 2, axes=(0, 1)) if backend == "theano" else kernel
            group["kernel:0"], group["bias:0"] = turned, bias
    return file


def keras_2_theano(path: Path, layers: Layers) -> Path:
    return keras_2(path, layers, backend="theano")


def keras_3(path: Path, layers: Layers) -> Path:
    """vgg16.weights.h5: layers of one class are counted."""
    file = path / "vgg16.weights.h5"
    with h5py.File(file, "w") as h5:
        for k, (kernel, bias) in enumerate(_bgr(layers).values()):
            group = h5.create_group(f"layers/conv2d{f'_{k}' * bool(k)}/vars")
            group["0"], group["1"] = kernel, bias
        h5["layers/dense/vars/0"] = np.zeros((8, 4), np.float32)
    return file


# -- MATLAB ----------------------------------------------------------------------------------------


def cell(items: list) -> np.ndarray:
    """A MATLAB cell, 1 x n."""
    made = np.empty((1, len(items)), object)
    for k, item in enumerate(items):
        made[0, k] = item
    return made


def _matlab_layers(layers: Layers, *, old: bool) -> list[dict]:
    made = []
    for name, (kernel, bias) in layers.items():
        arrays = (
            {"filters": kernel, "biases": bias[None]}
            if old
            else {"weights": cell([kernel, bias[:, None]])}
        )
        made += [{"type": "conv", "name": name, "pad": 1, **arrays}, {"type": "relu", "name": "r"}]
    return made


def _mean(*size: int) -> np.ndarray:
    return np.broadcast_to(np.asarray(MEAN, np.float32), (*size, 3)).copy()


def matconvnet(path: Path, layers: Layers) -> Path:
    """imagenet-vgg-verydeep-16.mat."""
    file = path / "imagenet-vgg-verydeep-16.mat"
    meta = {"normalization": {"averageImage": _mean(1, 1), "imageSize": [224.0, 224.0, 3.0]}}
    scipy.io.savemat(file, {"layers": cell(_matlab_layers(layers, old=False)), "meta": meta})
    return file


def matconvnet_old(path: Path, layers: Layers) -> Path:
    """As before beta 8: filters and biases, a mean image; compressed."""
    file = path / "old.mat"
    top = {
        "layers": cell(_matlab_layers(layers, old=True)),
        "normalization": {"averageImage": _mean(5, 4)},
        "classes": {"name": cell(["cat", "dog"])},
    }
    scipy.io.savemat(file, top, do_compression=True)
    return file


def netvlad(path: Path, layers: Layers, head: dict[str, np.ndarray]) -> Path:
    """NetVLAD's net after net_class2struct.m.

    Args:
      head: assignment and minus_centres (D x K), whitening, bias.
    """
    file = path / "Pitts30K_struct.mat"
    vlad = [head[name][None, None] for name in ("assignment", "minus_centres")]
    white = [head["whitening"][None, None], head["bias"][:, None]]
    every = [
        *_matlab_layers(layers, old=False),
        {"type": "custom", "name": "VLAD", "weights": cell(vlad), "K": 4.0},
        {"type": "conv", "name": "WPCA", "weights": cell(white)},
    ]
    meta = {"normalization": {"averageImage": _mean(1, 1)}}
    scipy.io.savemat(file, {"net": {"layers": cell(every), "meta": meta}})
    return file


WRITERS = {
    writer.__name__: writer
    for writer in (
        torchvision_zip,
        torchvision_legacy,
        torchvision_safetensors,
        keras_1,
        keras_theano,
        keras_2,
        keras_2_theano,
        keras_3,
        matconvnet,
        matconvnet_old,
    )
}
