"""`bench planes`: the measure against all assignments, and fitting exact planes."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import rng_of

from jaxsfm.bench.homography import warp
from jaxsfm.bench.planes import misclassification, read_points
from jaxsfm.cli.main import main


def brute_force(found, truth):
    """Every renaming of the found planes, those without a true one counted wrong."""
    best = len(truth)
    names = range(max(found.max(initial=-1), truth.max(initial=-1)) + 1)
    for order in itertools.permutations(names):
        renamed = np.asarray([order[label] if label >= 0 else -1 for label in found])
        best = min(best, int((renamed != truth).sum()))
    return best / len(truth)


@given(st.lists(st.tuples(st.integers(-1, 3), st.integers(-1, 3)), min_size=1, max_size=30))
def test_misclassification_is_the_least_over_all_namings(labels):
    found, truth = (np.asarray(column) for column in zip(*labels, strict=True))
    assert misclassification(found, truth) == pytest.approx(brute_force(found, truth))


def write_points(path, rng, *, per_plane=60, outliers=30):
    """Two planes 300 px apart in image 1, and outliers."""
    parts = []
    for plane, shift in enumerate((-150.0, 150.0)):
        h = np.asarray([[1.1, 0.1, shift], [-0.05, 0.9, 10], [1e-4, 1e-4, 1]])
        xy = rng.uniform(0, 500, size=(per_plane, 2))
        parts.append(
            np.c_[
                xy,
                np.ones(per_plane),
                warp(h, xy),
                np.ones(per_plane),
                np.full(per_plane, plane + 1),
            ]
        )
    off = rng.uniform(0, 500, size=(outliers, 4))
    ones = np.ones(outliers)
    parts.append(np.c_[off[:, :2], ones, off[:, 2:], ones, 0 * ones])
    np.savetxt(path, np.concatenate(parts))


@pytest.mark.slow
def test_exact_planes_among_outliers_are_found(tmp_path, capsys):
    write_points(tmp_path / "walls_pts.txt", rng_of(0))
    out = tmp_path / "f.json"
    assert main(["bench", "planes", "--root", str(tmp_path), "--json", str(out)]) == 0
    for row in json.loads(out.read_text())["rows"]:
        assert row["found"]["mean"] == 2 == row["planes"] and row["misclassified"]["max"] < 0.05
    assert "walls" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["", "1 2 3", "a b", "1 1 1 1 1 1 -2", "1 1 1 1 1 1 nan"])
def test_what_are_no_points_is_named(tmp_path, capsys, text):
    (tmp_path / "x_pts.txt").write_text(text)
    assert main(["bench", "planes", "--root", str(tmp_path)]) == 2
    assert "x_pts.txt" in capsys.readouterr().err


def test_label_zero_is_the_outliers(tmp_path):
    (tmp_path / "x_pts.txt").write_text("1 2 1 3 4 1 0\n5 6 1 7 8 1 2\n")
    points = read_points(tmp_path / "x_pts.txt")
    assert points.label.tolist() == [-1, 1] and points.xy1.tolist() == [[3, 4], [7, 8]]
