"""Data sets: downloads from a local server that breaks off, changes its mind or goes away."""

import dataclasses
import hashlib
import io
import json
import socket
import zipfile

import pytest
from local_server import CONTENT, url

from jaxsfm.bench import datasets
from jaxsfm.bench.datasets import DATA_SETS, DataSet, RemoteFile
from jaxsfm.cli.main import main
from jaxsfm.errors import UserError
from jaxsfm.io import download as downloads
from jaxsfm.io.atomic import only_process
from jaxsfm.io.download import download


def sha(content):
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def test_a_file_comes_once_and_its_bytes_are_told(server, tmp_path):
    told = []
    path = tmp_path / "folder" / "file"
    for _ in range(2):
        got = download(
            url(server), path, known_hash=sha(CONTENT), on_bytes=lambda *b: told.append(b)
        )
        assert got == path and path.read_bytes() == CONTENT
    assert len(server.asked) == 1 and told[-1] == (len(CONTENT), len(CONTENT))
    assert [p.name for p in path.parent.iterdir()] == ["file"]


@pytest.mark.parametrize("ranges", [True, False])
def test_a_download_that_broke_off_goes_on(server, tmp_path, ranges):
    server.break_after, server.ranges = 131_072, ranges
    with pytest.raises(UserError, match="broke off.*save the file yourself"):
        download(url(server), tmp_path / "file", known_hash=sha(CONTENT))
    assert not (tmp_path / "file").exists()
    server.break_after = None
    told = []
    download(
        url(server),
        tmp_path / "file",
        known_hash=sha(CONTENT),
        on_bytes=lambda done, total: told.append((done, total)),
    )
    assert (tmp_path / "file").read_bytes() == CONTENT
    assert server.asked[1] == ("/file", "bytes=131072-")
    assert told[-1] == (len(CONTENT), len(CONTENT))
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_parts_of_two_files_are_never_joined(server, tmp_path):
    server.break_after = 131_072
    with pytest.raises(UserError):
        download(url(server), tmp_path / "file", known_hash=None)
    server.break_after, server.files["/file"] = None, CONTENT[::-1]
    download(url(server), tmp_path / "file", known_hash=None)
    assert (tmp_path / "file").read_bytes() == CONTENT[::-1]


def test_a_part_that_is_whole_or_too_long_starts_again(server, tmp_path):
    server.break_after = 131_072
    with pytest.raises(UserError):
        download(url(server), tmp_path / "file", known_hash=None)
    server.break_after = None
    (tmp_path / "file.part").write_bytes(CONTENT + b"more")
    download(url(server), tmp_path / "file", known_hash=sha(CONTENT))
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_another_content_than_the_known_is_refused_and_not_kept(server, tmp_path):
    with pytest.raises(UserError, match="does not have the hash"):
        download(url(server), tmp_path / "file", known_hash=sha(b"other"))
    assert list(tmp_path.iterdir()) == []


def test_no_server_no_file_no_folder_are_one_sentence(server, tmp_path):
    with pytest.raises(UserError, match="the server answers 404"):
        download(url(server, "/none"), tmp_path / "file", known_hash=None)
    (tmp_path / "taken").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        download(url(server), tmp_path / "taken" / "file", known_hash=None)
    address = url(server)
    server.shutdown()
    server.server_close()
    with pytest.raises(UserError, match="no connection"):
        download(address, tmp_path / "file", known_hash=None)


def test_two_processes_do_not_write_one_file(server, tmp_path):
    with only_process(tmp_path / "file.part.lock", "held"):
        with pytest.raises(UserError, match="another process"):
            download(url(server), tmp_path / "file", known_hash=None)
    download(url(server), tmp_path / "file", known_hash=None)
    assert (tmp_path / "file").read_bytes() == CONTENT
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_server_that_says_nothing_is_not_waited_for_forever(tmp_path, monkeypatch):
    monkeypatch.setattr(downloads, "TIMEOUT", (0.2, 0.2))
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        with pytest.raises(UserError, match="did not answer in time"):
            address = f"http://127.0.0.1:{silent.getsockname()[1]}/file"
            download(address, tmp_path / "file", known_hash=None)


def archive(files):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as opened:
        for name, content in files.items():
            opened.writestr(name, content)
    return buffer.getvalue()


@pytest.fixture
def small(server, monkeypatch):
    """A data set of two archives that share a folder, and a file."""
    server.files = {
        "/a.zip": archive({"set/one.txt": b"1"}),
        "/b.zip": archive({"set/sub/two.txt": b"2"}),
        "/list.txt": b"one two",
    }
    files = (
        RemoteFile(url(server, "/a.zip"), "a.zip", sha(server.files["/a.zip"]), archive=True),
        RemoteFile(url(server, "/b.zip"), "b.zip", archive=True),
        RemoteFile(url(server, "/list.txt"), "pairs.txt"),
    )
    made = DataSet("Small", "page", "free", "1 kB", files, "set", ("set", "pairs.txt"), "wxbs")
    monkeypatch.setitem(DATA_SETS, "small", made)
    return made


def test_a_data_set_is_fetched_unpacked_and_found(server, small, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("JAXSFM_DATA", str(tmp_path))
    assert main(["data", "path", "small"]) == 2
    assert "jaxsfm data fetch small" in capsys.readouterr().err
    assert main(["data", "fetch", "small"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "small" / "set")
    home = tmp_path / "small"
    assert (home / "set/one.txt").read_bytes() == b"1"
    assert (home / "set/sub/two.txt").read_bytes() == b"2"
    assert (home / "pairs.txt").read_bytes() == b"one two"
    assert sorted(p.name for p in home.iterdir()) == ["fetched.json", "pairs.txt", "set"]
    asked = len(server.asked)
    server.shutdown()
    server.server_close()  # offline from here
    assert main(["data", "fetch", "small"]) == 0 and main(["data", "path", "small"]) == 0
    assert len(server.asked) == asked
    assert main(["data", "list"]) == 0
    text = capsys.readouterr().out
    assert "small      fetched" in text and "strecha    not fetched" in text


def test_an_interrupted_fetch_is_not_complete_and_goes_on(server, small, tmp_path):
    gone = server.files.pop("/list.txt")
    with pytest.raises(UserError, match="404"):
        datasets.fetch("small", tmp_path)
    (tmp_path / "small/pairs.txt").write_bytes(b"half")
    assert not datasets.is_complete("small", tmp_path)
    (tmp_path / "small/pairs.txt").unlink()
    server.files["/list.txt"] = gone
    server.asked.clear()
    datasets.fetch("small", tmp_path)
    assert [path for path, _ in server.asked] == ["/list.txt"]
    assert datasets.is_complete("small", tmp_path)


def test_what_somebody_else_put_there_is_used(small, tmp_path):
    home = tmp_path / "small"
    (home / "set").mkdir(parents=True)
    (home / "pairs.txt").write_text("")
    assert datasets.path_of("small", tmp_path) == home / "set"
    assert datasets.fetch("small", tmp_path) == home / "set"


def test_no_archive_writes_outside_its_folder(server, small, tmp_path, monkeypatch):
    server.files["/a.zip"] = archive({"../../escaped.txt": b"x", "set/one.txt": b"1"})
    first = dataclasses.replace(small.files[0], known_hash=None)
    monkeypatch.setitem(
        DATA_SETS, "small", dataclasses.replace(small, files=(first, *small.files[1:]))
    )
    datasets.fetch("small", tmp_path / "data")
    assert not list(tmp_path.glob("escaped.txt"))


def test_a_damaged_archive_and_a_damaged_record_are_one_sentence(
    server, small, tmp_path, monkeypatch
):
    server.files["/b.zip"] = server.files["/b.zip"][:-20]
    with pytest.raises(UserError, match="cannot be unpacked"):
        datasets.fetch("small", tmp_path)
    assert not datasets.is_complete("small", tmp_path)
    assert not (tmp_path / "small/b.zip").exists()  # or it would fail again for ever
    for text in ("{", "[]"):
        (tmp_path / "small/fetched.json").write_text(text)
        with pytest.raises(UserError, match="remove it"):
            datasets.fetch("small", tmp_path)


def test_every_data_set_says_what_it_is():
    for name, data_set in DATA_SETS.items():
        assert data_set.title and data_set.page and data_set.terms and data_set.size, name
        assert len({file.name for file in data_set.files}) == len(data_set.files)
        for file in data_set.files:
            assert file.known_hash is None or file.known_hash.split(":")[0] in ("sha256", "md5")
    assert len(DATA_SETS["strecha"].files) == 2 * 103 + 6
    with pytest.raises(UserError, match="no data set 'kitti'"):
        datasets.find("kitti")
    assert json.loads(json.dumps([dataclasses.asdict(d) for d in DATA_SETS.values()]))
