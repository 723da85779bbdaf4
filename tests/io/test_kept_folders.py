"""Laws of folders that are kept: what is computed once is computed again only if it must be."""

import pytest

from jaxsfm.io.atomic import PARTIAL
from jaxsfm.io.kept_folders import Steps
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


def test_a_part_is_computed_once_for_all_that_it_is_about(tmp_path, compute):
    steps = Steps(tmp_path / "steps", "key")
    first = steps.kept("part", [1, "a"], compute)
    assert steps.kept("part", [1, "a"], compute) == first and len(compute.calls) == 1
    assert (first / "file.txt").read_text() == "1"
    for other, kind, about in (
        (steps, "part", [2, "a"]),
        (steps, "another", [1, "a"]),
        (steps._replace(key="another"), "part", [1, "a"]),
    ):
        before = len(compute.calls)
        assert other.kept(kind, about, compute) != first and len(compute.calls) == before + 1


def test_a_torn_file_is_computed_again(tmp_path, compute):
    steps = Steps(tmp_path / "steps", "key")
    folder = steps.kept("part", [], compute)
    (folder / "file.txt").write_text("")
    assert steps.kept("part", [], compute) == folder
    assert (folder / "file.txt").read_text() == "2"


def test_what_fails_leaves_nothing_and_what_came_before_it_stays(tmp_path, compute):
    steps = Steps(tmp_path / "steps", "key")
    steps.kept("part", [1], compute)

    def fail(folder):
        (folder / "half").write_text("")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        steps.kept("part", [2], fail)
    assert len(list(steps.folder.iterdir())) == 1 and not list(tmp_path.glob(f"**/*{PARTIAL}"))
    steps.kept("part", [1], compute)
    assert len(compute.calls) == 1


def test_parts_of_a_stage_are_there_until_it_is_finished(tmp_path, compute):
    folder = WorkFolder(tmp_path, {})

    def stage(interrupted: bool) -> None:
        def run(fresh):
            folder.steps("mapped", "key").kept("part", [], compute)
            if interrupted:
                raise KeyboardInterrupt
            (fresh / "whole.txt").write_text("")

        folder.stage("mapped", "key", run)

    with pytest.raises(KeyboardInterrupt):
        stage(interrupted=True)
    assert folder.steps("mapped", "key").folder.is_dir()
    stage(interrupted=False)
    assert len(compute.calls) == 1 and not folder.steps("mapped", "key").folder.exists()
    assert [path.name for path in (tmp_path / "stages").iterdir()] == ["mapped"]
