"""Which of two mappings of the same photos is better."""

import itertools
from types import SimpleNamespace
from typing import Any

import pytest

from jaxsfm.runs.run_stages import MappedRun


def run(*sizes: int, green: bool = True, doubted: bool = False) -> Any:
    """Models of so many photos."""
    ends = itertools.accumulate(sizes)
    photos = [set(range(end - size, end)) for size, end in zip(sizes, ends, strict=True)]
    return SimpleNamespace(
        photos=photos,
        green=lambda: green,
        doubted=lambda: doubted,
        largest=lambda: max(map(len, photos), default=0),
    )


ORDER = [
    [run(), run(50, green=False)],  # none, or a doubtful one
    [run(2, 2), run(3)],
    [run(24, 10, 7, 6), run(24, 19, 10)],  # four places, of which one fell apart
    [run(10), run(10, 3)],
    [run(24, 19, 10), run(25)],
    [run(81, 28, green=False, doubted=True), run(80, 20, green=False)],  # only neighbours disagree
    [run(80, 12, green=False), run(81, 28, green=False, doubted=True)],  # fewer photos in all
    [run(80, 18, green=False), run(90, green=False, doubted=True)],  # more than a tenth fewer
    [run(80, green=False), run(10)],
]


@pytest.mark.parametrize(("worse", "better"), ORDER)
def test_larger_models_are_better_the_largest_first(worse, better):
    assert MappedRun.better_than(better, worse)
    assert not MappedRun.better_than(worse, better)
    assert not MappedRun.better_than(better, better)
