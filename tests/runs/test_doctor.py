"""The doctor says what is wrong with an installation, and nothing that is wrong ends the doctor."""

import os
from pathlib import Path

import pytest

from jaxsfm.cli.main import main
from jaxsfm.runs import doctor
from jaxsfm.runs.doctor import Finding, findings, hidden
from jaxsfm.runs.self_test import STEPS


@pytest.fixture
def quiet(monkeypatch):
    """The doctor without its self test."""
    monkeypatch.setattr(doctor, "_self_test", lambda: [Finding("test jax", "in /opt/x")])


def with_jax(monkeypatch, tmp_path: Path, jax: str) -> dict[str, Finding]:
    """What the self test finds if `import jax` runs this code."""
    (tmp_path / "jax.py").write_text(jax)
    monkeypatch.syspath_prepend(tmp_path)
    return {each.name: each for each in doctor._self_test()}


def test_a_jax_that_kills_its_process_is_a_finding(monkeypatch, tmp_path):
    found = with_jax(monkeypatch, tmp_path, "import os; os.kill(os.getpid(), 9)")
    assert "ended in this step: signal 9" in found["test jax"].text
    assert found["test weights"].good and "vgg16" in found["test weights"].text
    assert [name for name, each in found.items() if not each.good] == [
        f"test {step}" for step in STEPS[1:]
    ]


@pytest.mark.slow
def test_a_jax_that_does_not_start_is_a_finding_and_the_rest_is_tested(monkeypatch, tmp_path):
    found = with_jax(monkeypatch, tmp_path, "raise RuntimeError('this CPU has no AVX')")
    text = found["test jax"].text
    assert text.startswith("RuntimeError: this CPU has no AVX") and "jax.py, line 1" in text
    assert found["test colmap"].text == "left out, because a step before it failed"
    assert "Traceback" not in str(found)


def test_a_self_test_that_hangs_is_a_finding(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "PATIENCE_S", 3.0)
    found = with_jax(
        monkeypatch, tmp_path, "import time; print('noise', flush=True); time.sleep(60)"
    )
    hung = [each for each in found.values() if "had not ended after 3 s" in each.text]
    assert len(hung) == 1 and not any(each.good for each in found.values() if each in hung)


def test_a_question_that_fails_is_a_finding(monkeypatch, quiet):
    def broken():
        raise OSError("no such device")

    monkeypatch.setattr(doctor, "_system", broken)
    (found,) = [each for each in findings(paths=False) if not each.good]
    assert found == Finding("system", "OSError: no such device", good=False)


def test_a_package_that_a_run_needs_must_be_there(monkeypatch, quiet, capsys):
    needed = ["no-such-package>=1", "numpy>=2", 'no-extra>=1; extra == "x"']
    monkeypatch.setattr(doctor.importlib.metadata, "requires", lambda name: needed)
    assert main(["doctor"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "FAULT" in line] == [
        "no-such-package         FAULT: not installed"
    ]
    assert lines[-1].endswith("a plain run does not work")


def test_a_missing_extra_is_no_fault(monkeypatch, quiet, capsys):
    monkeypatch.setattr(doctor, "missing", lambda name: ["some-package"])
    assert main(["doctor"]) == 0
    assert "missing: some-package; needed for jaxsfm view" in capsys.readouterr().out


def test_paths_are_printed_only_if_they_are_asked_for(quiet, capsys):
    assert main(["doctor"]) == 0
    assert "/" not in capsys.readouterr().out.replace("jaxsfm/", "")
    assert main(["doctor", "--paths"]) == 0
    assert "in /opt/x" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "in /home/anna/photos/a.jpg: damaged",
        r"in C:\Users\anna\photos: damaged",
        f"in {Path.home()}/anna: damaged",
        f"in '{os.getcwd()}/anna'",
        "from https://anna:secret@host/simple",
    ],
)
def test_no_path_and_no_password_is_left(text):
    assert "anna" not in hidden(text) and "secret" not in hidden(text)


@pytest.mark.parametrize(
    "text", ["4 of 5 matches", "1 x NVIDIA H100 (gpu)", "https://pypi.org/simple/x", "and/or"]
)
def test_what_is_no_path_is_left_as_it_is(text):
    assert hidden(text) == text


@pytest.mark.slow
def test_a_good_installation_passes(capsys):
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "FAULT" not in text and "COLMAP verified" in text
    assert str(Path.home()) not in text
