"""Which Ray cluster is worked with, and how it is shared among workers."""

from importlib.util import find_spec

import pytest

from jaxsfm.errors import UserError
from jaxsfm.matching.ray_cluster import connect, share_cpus

# Not importorskip: it would import Ray before we have told it to be quiet.
pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


def test_an_address_where_nothing_answers_is_told_at_once():
    for address, why in (("127.0.0.1:1", "nothing answers"), ("ray://h:1", "must be HOST:PORT")):
        with pytest.raises(UserError, match=why), connect(address):
            pass


def test_cpus_are_shared_among_workers():
    assert share_cpus([8], None, 8) == (1, 8)
    assert share_cpus([8, 16], None, 8) == (3, 8)
    assert share_cpus([4, 16], None, 8) == (5, 4)
    assert share_cpus([8, 8], 3, 8) == (3, 4)
    with pytest.raises(UserError, match="--workers 3"):
        share_cpus([1, 1], 3, 8)
