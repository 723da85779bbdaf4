"""New results replace the old ones together, wherever the process is killed."""

import shutil
from pathlib import Path

import pytest

from jaxsfm.io.entries import RESULTS
from jaxsfm.io.work_folder import open_folder

IDENTITY = {"version": "1", "images": {"a.jpg": "00"}}


class Killed(BaseException):
    pass


def write_results(folder: Path, text: str, names=RESULTS) -> None:
    for name in names:
        if name == "sparse":
            (folder / name / "0").mkdir(parents=True)
            (folder / name / "0" / "points3D.bin").write_text(text)
        else:
            (folder / name).write_text(text)


def content(folder: Path) -> dict[str, str]:
    files = [folder / name for name in RESULTS if (folder / name).is_file()]
    files += folder.glob("sparse/0/*")
    return {str(file.relative_to(folder)): file.read_text() for file in files}


def killed_after(monkeypatch, steps: int) -> list[int]:
    """Let this many renames and removals happen, and count them."""
    done = [0]

    def counted(original):
        def wrapped(*args, **kwargs):
            if done[0] == steps:
                raise Killed
            done[0] += 1
            return original(*args, **kwargs)

        return wrapped

    monkeypatch.setattr(Path, "rename", counted(Path.rename))
    monkeypatch.setattr(Path, "unlink", counted(Path.unlink))
    monkeypatch.setattr(shutil, "rmtree", counted(shutil.rmtree))
    return done


@pytest.mark.parametrize("names", [RESULTS, RESULTS[1:], ("report.json", "sparse")])
def test_killed_at_any_step_the_next_run_finds_the_old_results_or_the_new_ones(
    tmp_path, monkeypatch, names
):
    def publish(out: Path, text: str, names=RESULTS) -> None:
        with open_folder(out, IDENTITY) as folder, folder.publish() as fresh:
            write_results(fresh, text, names)

    publish(tmp_path / "old", "old")
    publish(tmp_path / "new", "new", names)
    old, new = content(tmp_path / "old"), content(tmp_path / "new")
    assert set(new.values()) == {"new"} and len(new) == len(names)
    met, steps = [], 0
    while True:
        out = tmp_path / str(steps)
        publish(out, "old")
        with monkeypatch.context() as patch:
            killed_after(patch, steps)
            try:
                publish(out, "new", names)
                break
            except Killed:
                pass
        with open_folder(out, IDENTITY):
            found = content(out)
        assert found in (old, new)
        assert not (out / "publishing").exists()
        met.append(found == new)
        steps += 1
    assert content(out) == new
    assert met == sorted(met) and True in met and False in met


def test_results_without_a_model_do_not_replace_a_model(tmp_path):
    with open_folder(tmp_path, IDENTITY) as folder:
        for text, names in (("old", RESULTS), ("new", ("report.json", "database.db"))):
            with folder.publish() as fresh:
                write_results(fresh, text, names)
    assert set(content(tmp_path).values()) == {"old"}
    assert content(tmp_path / "failed") == {"report.json": "new", "database.db": "new"}
    with open_folder(tmp_path, IDENTITY) as folder, folder.publish() as fresh:
        write_results(fresh, "newest")
    assert set(content(tmp_path).values()) == {"newest"} and not (tmp_path / "failed").exists()


def test_a_failure_while_results_are_made_leaves_the_old_ones(tmp_path):
    with open_folder(tmp_path, IDENTITY) as folder:
        with folder.publish() as fresh:
            write_results(fresh, "old")
        with pytest.raises(Killed), folder.publish() as fresh:
            write_results(fresh, "new", ("report.json",))
            raise Killed
        assert set(content(tmp_path).values()) == {"old"}
        with folder.publish() as fresh:  # nor does it prevent the next run
            write_results(fresh, "newer")
    assert set(content(tmp_path).values()) == {"newer"}


def test_a_stage_is_found_under_its_key_alone_and_once_it_is_whole(tmp_path):
    ran = []

    def half(fresh):
        (fresh / "file").write_text("half")
        raise Killed

    def whole(fresh):
        assert not (fresh / "file").exists()
        (fresh / "file").write_text("whole")
        ran.append(fresh)

    with open_folder(tmp_path, IDENTITY) as folder:
        with pytest.raises(Killed):
            folder.stage("mapped", "k", half)
        for count, (name, key) in enumerate([("mapped", "k"), ("mapped", "l"), ("verified", "k")]):
            for _ in range(2):
                found = folder.stage(name, key, whole)
                assert (found / "file").read_text() == "whole" and len(ran) == count + 1
        folder.forget_stage("mapped")
        folder.stage("mapped", "l", whole)
        assert len(ran) == 4
