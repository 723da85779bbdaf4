"""The error rates of the check over its threshold."""

from jaxsfm.bench.ledger_table import THRESHOLDS, error_curve


def row(outcome, wrong):
    return {"outcome": outcome, "wrong": wrong}


def test_right_models_above_the_threshold_are_false_alarms_and_wrong_ones_below_it_misses():
    rows = [row("right", 0.04), row("split", 0.4), row("wrong, noticed", 0.25)]
    rows += [row("wrong, not noticed", 0.0), row("no model", None), row("not judged", 0.9)]
    found = {each.threshold: each for each in error_curve(rows)}
    assert found[0.02][1:] == (2, 2, 1, 2)
    assert found[0.2][1:] == (1, 2, 1, 2)
    assert found[0.3][1:] == (1, 2, 2, 2)
    assert found[0.5][1:] == (0, 2, 2, 2)


def test_with_the_threshold_false_alarms_fall_and_misses_grow():
    rows = [row("right", k / 10) for k in range(10)] + [
        row("wrong, noticed", k / 10) for k in (2, 8)
    ]
    curve = error_curve(rows)
    assert [each.threshold for each in curve] == sorted(THRESHOLDS)
    for before, after in zip(curve, curve[1:], strict=False):
        assert after.false_alarms <= before.false_alarms and after.misses >= before.misses
