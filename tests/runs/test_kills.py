"""Killed at any moment, a run goes on to the very database and model that it would have made."""

import json
import signal
from pathlib import Path

import numpy as np
import pytest
from kept_runs import results
from nursery import Nursery

from jaxsfm.bench.synthetic import write_scene
from jaxsfm.io.atomic import load_arrays
from jaxsfm.io.entries import PARTIAL

KILLS, ROUNDS, SEED = 15, 4, 8
"""Fifteen kills, one in each fifteenth of a run, meet more different moments than as many at random
and cost a quarter of the time of fifty. How many they meet depends on how busy the machine is, so
there are more rounds of them, up to this number, until they have met enough."""
MOMENTS = 5
"""Different states of the work folder that kills must have met."""
OPTIONS = ("--preset", "paper", "--refine", "1", "--threads", "1", "--pairs", "exhaustive")


@pytest.fixture
def nursery(tmp_path):
    (tmp_path / "compiled").mkdir()
    made = Nursery(tmp_path / "compiled")
    yield made
    made.end()


def assert_whole(out: Path) -> None:
    """Nothing is half there but what says so by its name; call after a kill."""
    for file in out.glob("*/*/*.safetensors"):
        assert load_arrays(file) is not None, file
    for name in ("run.json", "report.json"):
        if (out / name).exists():
            json.loads((out / name).read_text())


@pytest.mark.slow
def test_killed_in_every_part_of_a_run_nothing_is_lost_or_changed(tmp_path, nursery):
    write_scene(tmp_path, num_views=4, size=(192, 144))
    command = ["reconstruct", str(tmp_path / "images"), *OPTIONS, "--out"]
    whole = tmp_path / "whole"
    status, _ = nursery.run([*command, str(whole)])  # compiles
    assert status == 0, nursery.log.read_text(errors="replace")[-2000:]
    status, seconds = nursery.run([*command, str(tmp_path / "again")])
    assert status == 0 and results(tmp_path / "again") == results(whole)
    rng = np.random.default_rng(SEED)
    finished, steps = 0, set()

    def moments():
        for number in range(ROUNDS):
            if number and finished and len(steps) >= MOMENTS:
                return
            yield from rng.permutation(
                seconds * (np.arange(KILLS) + rng.uniform(size=KILLS)) / KILLS
            )

    for moment in moments():
        out = tmp_path / f"out{finished}"
        status, _ = nursery.run([*command, str(out)], moment)
        assert status in (0, -signal.SIGKILL), nursery.log.read_text(errors="replace")[-2000:]
        if out.exists():
            steps.add(
                (
                    *sorted(p.name for p in out.iterdir()),
                    *(len(list(out.glob(f"{kind}/*/*"))) for kind in ("features", "matches")),
                )
            )
            assert_whole(out)
        if status == 0:
            assert results(out) == results(whole)
            finished += 1
    status, _ = nursery.run([*command, str(out)])
    assert status == 0 and results(out) == results(whole)
    assert not list(tmp_path.glob(f"out*/**/*{PARTIAL}"))
    assert finished >= 1 and len(steps) >= MOMENTS, "the kills must meet different moments"
