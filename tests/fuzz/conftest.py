"""How many cases of damage are tried."""

import pytest


@pytest.fixture(
    params=[
        pytest.param(0.1, id="a tenth"),
        pytest.param(1.0, id="all", marks=pytest.mark.slow),
    ]
)
def share(request) -> float:
    """The part of the cases that is tried: quick tests try the first tenth."""
    return request.param
