"""`bench confidence`: the laws of a reliability diagram, and a run on a rendered set."""

import json

import numpy as np
import pytest
from strategies import rng_of

from jaxsfm.bench.confidence import summary
from jaxsfm.bench.reliability import (
    EDGES,
    bins,
    calibration_error,
    curve_at,
    fitted_curve,
    squared_error,
)
from jaxsfm.bench.wxbs import HALVES
from jaxsfm.cli.main import main
from jaxsfm.sfm.two_photos.matched import HALF_SURE, POWER, confidence


def test_everything_is_in_the_bin_of_its_confidence():
    rng = rng_of(0)
    given, right = [*rng.uniform(size=200), *EDGES], [*(rng.random(200) < 0.5), *([True] * 6)]
    found = bins(given, right)
    for k, (low, high) in enumerate(zip(EDGES[:-1], EDGES[1:], strict=True)):
        last = high == EDGES[-1]
        inside = [i for i, c in enumerate(given) if low <= c and (c < high or last)]
        assert found[k]["above"] == low and found[k]["count"] == len(inside)
        assert found[k]["confidence"] == pytest.approx(np.mean([given[i] for i in inside]))
        assert found[k]["right"] == pytest.approx(np.mean([right[i] for i in inside]))
    assert sum(each["count"] for each in found) == len(given)
    assert [each["above"] for each in bins([0.95, 0.02], [True, False])] == [0.0, 0.9]


def test_true_probabilities_have_a_small_calibration_error_and_false_ones_a_large_one():
    rng = rng_of(0)
    given = rng.uniform(size=4000)
    right = rng.random(4000) < given
    assert calibration_error(bins(given, right)) < 0.03
    assert calibration_error(bins(1 - given, right)) > 0.3
    assert calibration_error(bins([1.0, 1.0], [True, False])) == pytest.approx(0.5)


def test_squared_errors_are_those_of_certainty():
    assert squared_error([1.0, 0.0], [True, False]) == 0
    assert squared_error([1.0, 0.5], [False, True]) == pytest.approx(0.625)


def test_a_fitted_curve_is_the_one_that_made_the_data():
    rng = rng_of(0)
    evidence = np.exp(rng.uniform(0, 9, 4000))
    right = rng.random(4000) < curve_at(evidence, (90.0, 1.5))
    half, power = fitted_curve(evidence, right)
    assert half == pytest.approx(90, rel=0.15) and power == pytest.approx(1.5, rel=0.1)
    assert fitted_curve([1.0, 2.0], [True, True]) is None


def test_few_things_that_one_evidence_parts_are_not_fitted_by_a_step():
    """The most likely curve would be a step between 100 and 200."""
    half, power = fitted_curve([10.0, 50.0, 100.0, 200.0, 900.0], [False] * 3 + [True] * 2)
    assert 100 < half < 200 and 0.5 < power < 10
    more = [*np.linspace(1, 100, 200), *np.linspace(200, 900, 200)]
    assert fitted_curve(more, [False] * 200 + [True] * 200)[1] > 2 * power


def test_the_curve_in_use_is_that_of_the_confidence():
    given = [0.0, 1.0, 60.0, HALF_SURE, 5000.0]
    found = curve_at(given, (HALF_SURE, POWER))
    assert found == pytest.approx([confidence(e) for e in given])


def test_the_curve_is_fitted_on_one_half_and_tested_on_the_other():
    def row(half, evidence, right):
        given = {"half": half, "evidence": evidence, "right": right, "method": "default"}
        return {**given, "confidence": confidence(evidence)}

    chosen = [row(HALVES[0], e, e > 100) for e in (0, 40, 80, 90, 110, 120, 400) * 20]
    tested = [row(HALVES[1], 80, False), row(HALVES[1], 150, True)]
    found = summary(chosen + tested)["default"]
    assert found["pairs"] == 142
    half, power = found["fitted"]
    assert 90 < half < 110
    ours, fitted = found["on_other_half"]
    assert ours == pytest.approx(squared_error([confidence(80), confidence(150)], [False, True]))
    assert fitted == pytest.approx(squared_error(curve_at([80, 150], (half, power)), [False, True]))
    assert fitted < ours
    assert summary(tested)["default"]["on_other_half"] is None


@pytest.mark.slow
def test_drawn_pairs_are_matched_and_a_diagram_is_drawn(strecha, tmp_path, capsys):
    out, diagram = tmp_path / "figures.json", tmp_path / "diagram.png"
    args = ["--root", str(strecha), "--methods", "paper", "--max-size", "256", "--pairs", "3"]
    args += ["--json", str(out), "--diagram", str(diagram)]
    assert main(["bench", "confidence", *args]) == 0
    figures = json.loads(out.read_text())
    assert len(figures["rows"]) == 3 and figures["summary"]["paper"]["pairs"] == 3
    assert diagram.read_bytes().startswith(b"\x89PNG")
    assert "calibration error" in capsys.readouterr().out
