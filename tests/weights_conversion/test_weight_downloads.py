"""Public weights are fetched, compared with their hash, and converted."""

import hashlib

import platformdirs
import pytest
from imitations import SMALL
from local_server import url

from jaxsfm.errors import UserError
from jaxsfm.io.weight_files import read_converted
from jaxsfm.weights_conversion import fetch
from jaxsfm.weights_conversion.fetch import PUBLIC, PublicWeights, fetch_weights


def public(address: str, content: bytes, family="keras") -> PublicWeights:
    return PublicWeights(address, f"md5:{hashlib.md5(content).hexdigest()}", family, 1, "")


@pytest.fixture
def own_folders(tmp_path, monkeypatch):
    """The user's cache and data folders."""
    for name in ("user_cache_path", "user_data_path"):
        monkeypatch.setattr(platformdirs, name, lambda _, name=name: tmp_path / name)
    return tmp_path


def test_a_fetched_file_is_converted_into_the_data_folder(files, own_folders, server, monkeypatch):
    read = fetch.read_source
    monkeypatch.setattr(fetch, "read_source", lambda path, **k: read(path, **k, shapes=SMALL))
    data = server.files["/vgg.h5"] = files["keras_3"].read_bytes()
    monkeypatch.setitem(PUBLIC, "keras", public(url(server, "/vgg.h5"), data))
    path = fetch_weights("keras")
    assert path == own_folders / "user_data_path" / "weights" / "keras.safetensors"
    assert read_converted(path, shapes=SMALL).family == "keras"
    fetch_weights("keras", out=own_folders / "other.safetensors")
    assert (own_folders / "other.safetensors").exists() and len(server.asked) == 1


def test_a_fetched_file_must_be_of_its_family(files, own_folders, server, monkeypatch):
    read = fetch.read_source
    monkeypatch.setattr(fetch, "read_source", lambda path, **k: read(path, **k, shapes=SMALL))
    data = server.files["/vgg.h5"] = files["keras_3"].read_bytes()
    monkeypatch.setitem(PUBLIC, "caffe", public(url(server, "/vgg.h5"), data, family="caffe"))
    with pytest.raises(UserError, match="is of the family keras"):
        fetch_weights("caffe")


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(UserError, match="'nonsense'; there are torchvision, keras"):
        fetch_weights("nonsense")


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_file_has_a_whole_hash_and_https(name):
    file = PUBLIC[name]
    algorithm, _, digest = file.known_hash.partition(":")
    assert len(digest) == 2 * hashlib.new(algorithm).digest_size and int(digest, 16)
    assert file.url.startswith("https://") and file.licence and name.startswith(file.family)
