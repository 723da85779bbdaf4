"""Grouping of observations."""

import numpy as np
import pytest

from jaxsfm.colmap.tracks import present_groups


@pytest.mark.parametrize("of", [[], [3], [2, 0, 2, 5, 0, 2], [1, 1, 1]])
def test_each_group_that_is_present_has_its_entries_in_their_order(of):
    groups = present_groups(np.asarray(of, np.int64))
    assert [(k, rows.tolist()) for k, rows in groups] == [
        (k, [at for at, each in enumerate(of) if each == k]) for k in sorted(set(of))
    ]
