"""Downloads from a server of this machine: whole and known, or one sentence and nothing left."""

import contextlib
import hashlib
import http.server
import socket
import threading

import platformdirs
import pytest
from imitations import SMALL

from jaxsfm.errors import UserError
from jaxsfm.host.converted import read_converted
from weights_conversion import fetch
from weights_conversion.fetch import PUBLIC, Public, download, fetch_weights

CONTENT = bytes(range(256)) * 64


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


@contextlib.contextmanager
def serving(content: bytes, *, promised: int | None = None, status: int = 200):
    """The URL of a server that sends the content once and again; promised: Content-Length."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_response(status)
            self.send_header("Content-Length", str(promised or len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/vgg.bin", asked
        finally:
            server.shutdown()
            thread.join()


def public(url: str, content: bytes = CONTENT, *, algorithm: str = "md5", family="keras") -> Public:
    return Public(url, f"{algorithm}:{hashlib.new(algorithm, content).hexdigest()}", family, 1, "")


@pytest.mark.parametrize("algorithm", ["md5", "sha256"])
def test_the_known_file_is_kept_and_not_asked_for_again(tmp_path, algorithm):
    with serving(CONTENT) as (url, asked):
        file = public(url, algorithm=algorithm)
        path = download(file, tmp_path / "new" / "folder")
        assert path.read_bytes() == CONTENT
        assert download(file, path.parent) == path and len(asked) == 1
        path.write_bytes(b"damaged")
        assert download(file, path.parent).read_bytes() == CONTENT and len(asked) == 2


def test_another_file_than_the_known_one_is_not_kept(tmp_path):
    with serving(CONTENT[:-1] + b"x") as (url, _):
        with pytest.raises(UserError, match=f"{url}: what came is not the known file.*md5:"):
            download(public(url), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_transfer_that_breaks_off_is_not_kept(tmp_path):
    with serving(CONTENT[:1000], promised=len(CONTENT)) as (url, _):
        with pytest.raises(UserError, match=r"cannot be downloaded \(the connection broke"):
            download(public(url), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_no_connection_and_no_such_file_are_told_apart(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/vgg.bin"
    with pytest.raises(UserError, match=r"cannot be downloaded \(no connection\).*weights convert"):
        download(public(url), tmp_path)
    with serving(b"", status=404) as (url, _):
        with pytest.raises(UserError, match="the server answers 404"):
            download(public(url), tmp_path)


def test_a_server_that_says_nothing_is_not_waited_for_forever(tmp_path, monkeypatch):
    monkeypatch.setattr(fetch, "TIMEOUT_S", 0.2)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/vgg.bin"
        with pytest.raises(UserError, match="the server does not answer"):
            download(public(url), tmp_path)


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with serving(CONTENT) as (url, _):
        with pytest.raises(UserError, match="file/folder: cannot be made"):
            download(public(url), tmp_path / "file" / "folder")


def test_a_disk_that_takes_nothing_is_one_sentence(tmp_path, monkeypatch):
    def full(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(fetch.pooch, "retrieve", full)
    with pytest.raises(UserError, match="cannot be written .Permission denied"):
        download(public("http://127.0.0.1/x"), tmp_path)


@pytest.fixture
def own_folders(tmp_path, monkeypatch):
    """The user's cache and data folders."""
    for name in ("user_cache_path", "user_data_path"):
        monkeypatch.setattr(platformdirs, name, lambda _, name=name: tmp_path / name)
    return tmp_path


def test_a_fetched_file_is_converted_into_the_data_folder(files, own_folders, monkeypatch):
    read = fetch.read_source
    monkeypatch.setattr(fetch, "read_source", lambda path, **k: read(path, **k, shapes=SMALL))
    data = files["keras_3"].read_bytes()
    with serving(data) as (url, asked):
        monkeypatch.setitem(PUBLIC, "keras", public(url, data))
        path = fetch_weights("keras")
        assert path == own_folders / "user_data_path" / "weights" / "keras.safetensors"
        assert read_converted(path, shapes=SMALL).family == "keras"
        fetch_weights("keras", out=own_folders / "other.safetensors")
        assert (own_folders / "other.safetensors").exists() and len(asked) == 1


def test_a_fetched_file_must_be_of_its_family(files, own_folders, monkeypatch):
    read = fetch.read_source
    monkeypatch.setattr(fetch, "read_source", lambda path, **k: read(path, **k, shapes=SMALL))
    data = files["keras_3"].read_bytes()
    with serving(data) as (url, _):
        monkeypatch.setitem(PUBLIC, "caffe", public(url, data, family="caffe"))
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
