"""Ctrl-C in each stage: nothing computed is lost, and the same command goes on."""

import contextlib
import signal
import subprocess
import sys
import time

import pytest

import jaxsfm.runs.run_stages
from jaxsfm.cli.main import main
from jaxsfm.errors import UserError
from jaxsfm.io.store import Store
from jaxsfm.matching import extraction, pair_matching

QUICK = ("--preset", "paper")
"""What is interrupted does not matter: fewer and smaller programs to compile."""


def interrupt_after(monkeypatch, owner, name: str, calls: int) -> list[int]:
    """Let `owner.name` work `calls` times, then raise KeyboardInterrupt; counts the calls."""
    count = [0]
    original = getattr(owner, name)

    def wrapped(*args, **kwargs):
        if count[0] == calls:
            raise KeyboardInterrupt
        count[0] += 1
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, wrapped)
    return count


@pytest.mark.parametrize(
    ("stage", "owner", "function", "calls"),
    [
        ("extraction", Store, "save_features", 1),
        ("matching", Store, "save_matches", 2),
        ("mapping", jaxsfm.runs.run_stages, "walk", 0),
    ],
)
@pytest.mark.slow
def test_an_interrupted_run_goes_on_where_it_was(
    scene,
    tmp_path,
    monkeypatch,
    capsys,
    stage,
    owner,
    function,
    calls,
):
    args = ["reconstruct", str(scene / "images"), *QUICK, "--threads", "1", "--out"]
    assert main([*args, str(tmp_path / "whole")]) == 0
    with monkeypatch.context() as patch:
        interrupt_after(patch, owner, function, calls)
        assert main([*args, str(tmp_path / "cut")]) == 130
    assert "interrupted" in capsys.readouterr().err
    done = len(list((tmp_path / "cut").glob("features/*/*.safetensors")))
    matched = len(list((tmp_path / "cut").glob("matches/*/*.safetensors")))
    assert (done, matched) == {"extraction": (1, 0), "matching": (3, 2), "mapping": (3, 3)}[stage]
    extracted = interrupt_after(monkeypatch, Store, "save_features", 99)
    rematched = interrupt_after(monkeypatch, Store, "save_matches", 99)
    assert main([*args, str(tmp_path / "cut")]) == 0
    assert extracted[0] == 3 - done and rematched[0] == 3 - matched
    for file in sorted((tmp_path / "whole" / "matches").glob("*/*.safetensors")):
        again = tmp_path / "cut" / file.relative_to(tmp_path / "whole")
        assert file.read_bytes() == again.read_bytes()
    for name in ("images.bin", "points3D.bin"):
        one, two = (tmp_path / run / "sparse" / "0" / name for run in ("whole", "cut"))
        assert one.read_bytes() == two.read_bytes()


def test_an_interrupt_that_a_callback_swallowed_still_ends_the_run(
    scene, tmp_path, monkeypatch, capsys
):
    """Like JAX's garbage collector hook, which Python lets print and forget the exception."""
    original = Store.save_features

    def swallowing(*args, **kwargs):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return original(*args, **kwargs)

    monkeypatch.setattr(Store, "save_features", swallowing)
    command = ["reconstruct", str(scene / "images"), *QUICK, "--out", str(tmp_path / "out")]
    assert main(command) == 130
    assert "interrupted" in capsys.readouterr().err
    # The photo that was saved, and the one that was on its way meanwhile.
    assert len(list((tmp_path / "out" / "features").glob("*/*"))) == 2


@pytest.mark.parametrize(
    "owner, stage",
    [(extraction, "features"), (pair_matching, "matches")],
    ids=["extraction", "matching"],
)
@pytest.mark.parametrize("error, code", [(KeyboardInterrupt, 130), (UserError("gone"), 2)])
def test_what_has_been_started_is_saved(scene, tmp_path, monkeypatch, owner, stage, error, code):
    """Ctrl-C reaches Python when a batch has just been computed; so does what fails next."""
    name = {"features": "_extract", "matches": "_match"}[stage]
    original, calls = getattr(owner, name), [0]

    def failing(*args, **kwargs):
        calls[0] += 1
        if calls[0] == 2:
            raise error
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, failing)
    command = ["reconstruct", str(scene / "images"), *QUICK, "--out", str(tmp_path / "out")]
    assert main(command) == code
    assert len(list((tmp_path / "out" / stage).glob("*/*.safetensors"))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_real_signal_ends_the_process_cleanly(scene, tmp_path, number):
    command = [sys.executable, "-m", "jaxsfm.cli.main", "reconstruct", str(scene / "images")]
    log = tmp_path / "log"
    with log.open("w") as file:
        process = subprocess.Popen([*command, "--out", str(tmp_path / "out")], stderr=file)
        deadline = time.monotonic() + 120
        while "extraction:" not in log.read_text() and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(60) == 130
    text = log.read_text()
    assert "interrupted" in text
    assert "Traceback" not in text and "stack trace" not in text


@pytest.mark.slow
def test_ctrl_c_during_refinement_keeps_features_and_matches(scene, tmp_path, monkeypatch, capsys):
    import jaxsfm.sfm.refine.one_pass

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    args = ["reconstruct", str(scene / "images"), "--threads", "1", "--out", str(tmp_path / "out")]
    with monkeypatch.context() as patch:
        patch.setattr(jaxsfm.sfm.refine.one_pass, "adjusted", interrupted)
        assert main(args) == 130
    assert len(list((tmp_path / "out" / "matches").glob("*/*.safetensors"))) == 3
    assert not (tmp_path / "out" / "sparse").exists()
    assert main(args) == 0
    assert (tmp_path / "out" / "sparse" / "0" / "images.bin").is_file()


MAP_AND_INTERRUPT = """
import os, signal, sys, threading, time
import jaxsfm.cli.main
from jaxsfm.colmap import mapper
import pycolmap

kind, path = sys.argv[1:]
options = pycolmap.SyntheticDatasetOptions(
    num_rigs=1, num_frames_per_rig=60, num_points3D=4000, num_points2D_without_point3D=0
)
with pycolmap.Database.open(path) as db:
    pycolmap.synthesize_dataset(options, db)

def interrupt():
    time.sleep(1)
    os.kill(os.getpid(), signal.SIGINT)

def stuck():
    threading.Thread(target=interrupt, daemon=True).start()
    mapper.build_models(path, {}, mapper.MapOptions(mapper=kind, threads=1))

jaxsfm.cli.main.COMMANDS["stuck"] = stuck
sys.exit(jaxsfm.cli.main.main(["stuck"]))
"""


@pytest.mark.parametrize("mapper", ["incremental", "global"])
@pytest.mark.slow
def test_a_signal_during_native_mapping_ends_the_process_cleanly(tmp_path, mapper):
    """Ctrl-C inside Thread.join let Python 3.11 shut down under running native code: SIGABRT."""
    command = [sys.executable, "-c", MAP_AND_INTERRUPT, mapper, str(tmp_path / "d.db")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    assert "interrupted" in done.stderr and "terminate" not in done.stderr
