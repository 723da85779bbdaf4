"""Laws of stages that are kept: what is computed once is computed again only if it must be."""

import pytest

from jaxsfm.io.entries import PARTIAL
from jaxsfm.io.work_folder import WorkFolder


@pytest.fixture
def compute():
    """Writes a file, and counts how often."""
    calls = []

    def write(folder):
        calls.append(folder)
        (folder / "file.txt").write_text(f"{len(calls)}")

    write.calls = calls
    return write


def test_a_stage_is_computed_once_for_all_that_it_depends_on(tmp_path, compute):
    work = WorkFolder(tmp_path, {})
    first = work.stage("mapped", "key", compute)
    assert work.stage("mapped", "key", compute) == first and len(compute.calls) == 1
    assert (first / "file.txt").read_text() == "1"
    for name, key in (("mapped", "another"), ("refined", "key")):
        before = len(compute.calls)
        work.stage(name, key, compute)
        assert len(compute.calls) == before + 1


def test_a_stage_that_is_forgotten_is_computed_again(tmp_path, compute):
    work = WorkFolder(tmp_path, {})
    work.stage("mapped", "key", compute)
    work.forget_stage("mapped")
    work.stage("mapped", "key", compute)
    assert len(compute.calls) == 2


def test_a_torn_file_is_computed_again(tmp_path, compute):
    work = WorkFolder(tmp_path, {})
    folder = work.stage("mapped", "key", compute)
    (folder / "file.txt").write_text("")
    assert work.stage("mapped", "key", compute) == folder
    assert (folder / "file.txt").read_text() == "2"


def test_what_fails_leaves_nothing_and_what_came_before_it_stays(tmp_path, compute):
    work = WorkFolder(tmp_path, {})
    work.stage("mapped", "key", compute)

    def fail(folder):
        (folder / "half").write_text("")
        raise KeyboardInterrupt

    for name, key in (("refined", "key"), ("mapped", "another")):
        with pytest.raises(KeyboardInterrupt):
            work.stage(name, key, fail)
    assert [path.name for path in (tmp_path / "stages").iterdir()] == ["mapped"]
    assert not list(tmp_path.glob(f"**/*{PARTIAL}"))
    work.stage("mapped", "key", compute)
    assert len(compute.calls) == 1
