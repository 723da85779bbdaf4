"""The commands `jaxsfm weights` convert good files and refuse bad ones."""

import pytest
from imitations import SMALL, random_layers, torchvision_legacy
from shared import once

from jaxsfm.cli.main import main
from jaxsfm.core.vgg import LAYERS
from jaxsfm.weights_conversion.convert import read_source, write_converted
from jaxsfm.weights_conversion.source import Source
from jaxsfm.weights_conversion.torchvision import CONVENTION


@pytest.fixture(scope="session")
def other(tmp_path_factory):
    """The source and the conversion of a whole VGG-16 with random weights."""
    target = "random.safetensors"

    def make(folder):
        source = torchvision_legacy(folder, random_layers(LAYERS))
        assert main(["weights", "convert", str(source), str(folder / target)]) == 0

    with once(tmp_path_factory, "converted", make) as folder:
        (source,) = (path for path in folder.iterdir() if path.name != target)
        yield source, folder / target


def refused(capsys, *args) -> str:
    assert main([str(a) for a in args]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxsfm: ") and error.count("\n") == 1 and "Traceback" not in error
    return error


@pytest.mark.slow
def test_a_conversion_is_verified_and_shown(other, capsys):
    source, target = other
    assert main(["weights", "verify", str(source), str(target), "--size", "40"]) == 0
    text = capsys.readouterr().out
    assert "conv5_3" in text and "agree: largest difference" in text
    for args in (["weights", "--weights", target], ["weights", "show", "--weights", target]):
        assert main([str(a) for a in args]) == 0
        text = capsys.readouterr().out
        for word in (target, "vgg16-397923af.pth", "torchvision", "0.485", "trained on other"):
            assert str(word) in text


@pytest.mark.slow
def test_another_network_does_not_verify(other, tmp_path, capsys):
    source, _ = other
    read = read_source(source)
    layers = {**read.layers, "conv1_2": (-read.layers["conv1_2"][0], read.layers["conv1_2"][1])}
    wrong = Source(
        family="torchvision",
        path=source,
        sha256="",
        layers=layers,
        convention=CONVENTION,
        preprocessing=read.preprocessing,
    )
    write_converted(wrong, tmp_path / "wrong.safetensors")
    verify = ["weights", "verify", str(source), str(tmp_path / "wrong.safetensors"), "--size", "40"]
    assert main(verify) == 1
    text = capsys.readouterr().out
    assert "DIFFER" in text and text.count("TOO LARGE") == 17  # all but conv1_1


@pytest.mark.parametrize("command", ["match", "reconstruct"])
def test_learned_keypoints_of_other_weights_are_refused_at_once(
    other, scene, tmp_path, capsys, command
):
    _, target = other
    views = [scene / "images" / f"view{k}.png" for k in (0, 2)]
    given = views if command == "match" else [scene / "images"]
    out = tmp_path / ("a.npz" if command == "match" else "out")
    error = refused(
        capsys, command, *given, "--out", out, "--keypoints", "learned", "--weights", target
    )
    assert "relocalizer was trained on other weights" in error and "--keypoints" in error
    assert str(target) in error and not out.exists()


def test_bad_arguments_are_one_sentence(files, tmp_path, capsys):
    good = files["keras_1"]
    assert "must end in .safetensors" in refused(capsys, "weights", "convert", good, "out.h5")
    out = tmp_path / "out.safetensors"
    missing = tmp_path / "missing.h5"
    assert str(missing) in refused(capsys, "weights", "convert", missing, out)
    assert "conv1_1 must be" in refused(capsys, "weights", "convert", good, out)  # of SMALL
    assert "no public weights 'x'" in refused(capsys, "weights", "fetch", "x")
    assert "--size" in refused(capsys, "weights", "verify", good, out, "--size", "8")
    assert str(missing) in refused(capsys, "weights", "--weights", missing)
    assert not out.exists()


def test_fetch_alone_lists_what_there_is(capsys):
    assert main(["weights", "fetch"]) == 0
    text = capsys.readouterr().out
    for word in ("vgg16-397923af.pth", "sha256:397923af8e79", "Creative Commons", "BSD"):
        assert word in text


def test_small_networks_are_for_tests_only():
    assert SMALL.keys() == LAYERS.keys() and SMALL["conv5_3"] == (32, 32)
