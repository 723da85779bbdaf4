"""The benchmarks' gate, and a run of the shortest group."""

import json

import pytest

from jaxsfm.bench.speed import __main__ as benchmarks
from jaxsfm.bench.speed.timing import Metric, ratio


@pytest.mark.parametrize(
    "better, value, lost", [("higher", 0.79, True), ("higher", 0.81, False), ("lower", 1.21, True)]
)
def test_the_gate_looks_in_the_direction_that_is_worse(better, value, lost):
    assert benchmarks.worse(Metric("m", value, "x", better, 0.2), 1.0) == lost
    assert not benchmarks.worse(Metric("m", value, "s", better), 1.0)


def test_ratios_are_taken_turn_by_turn():
    metric = ratio("m", [2.0, 20.0, 4.0], [1.0, 10.0, 1.0], "higher", 0.2)
    assert metric.value == 2.0


@pytest.mark.slow
def test_homographies_are_measured_with_their_accuracy(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(benchmarks, "BASELINE", tmp_path / "baseline.json")
    assert benchmarks.main(only=("homographies",), update=True) == 0
    found = json.loads((tmp_path / "baseline.json").read_text())
    assert found["homography.hypotheses"] == 2048
    assert found["homography.inliers_over_opencv_ransac"] > 0.98
    assert "homography.seconds" in capsys.readouterr().out


def test_an_unknown_group_is_one_sentence(capsys):
    assert benchmarks.main(only=("speed",)) == 2
    assert "not one of machine" in capsys.readouterr().err
