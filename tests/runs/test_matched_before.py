"""What is said of pairs that need not be matched again."""

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from jaxsfm.core.types import Status
from jaxsfm.io.pairs import PairCounts
from jaxsfm.runs.job import match_pairs

PAIRS = [("a", "b"), ("a", "c")]


@pytest.mark.parametrize("progress", [True, False])
def test_a_run_says_how_many_pairs_were_matched_before_and_a_trial_does_not(caplog, progress):
    """A run of 51 trials that went on said it 151 times."""
    counts = PairCounts(9, 1, 30, 0, Status.VERIFIED)
    job: Any = SimpleNamespace(
        store=SimpleNamespace(load_matches=lambda pair: SimpleNamespace(counts=counts)),
        extract_missing=lambda images: {},
        match_missing=lambda by_name, pairs: [],
        progress=progress,
    )
    with caplog.at_level(logging.INFO, "jaxsfm"):
        found, lost = match_pairs(job, {}, PAIRS, {})
    assert found == dict.fromkeys(PAIRS, counts) and not lost
    assert ("2 of 2 pairs are matched already" in caplog.text) == progress
