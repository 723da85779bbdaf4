"""How many cases of damage are tried."""

import sys

import pytest

# Without a limit of memory, which only Linux sets in this way, a damaged size could take all of it.
collect_ignore_glob = [] if sys.platform == "linux" else ["test_fuzz_*.py"]


@pytest.fixture(
    params=[
        pytest.param(0.1, id="a tenth"),
        pytest.param(1.0, id="all", marks=pytest.mark.slow),
    ]
)
def share(request) -> float:
    """The part of the cases that is tried: the quick tests try the first tenth."""
    return request.param


@pytest.fixture
def least(share) -> float:
    """The factor of the numbers of cases that must end in one way.

    It is half of the share among few cases, because their numbers vary more.
    """
    return share if share == 1 else share / 2
