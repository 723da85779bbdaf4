"""The matches of a run that looks at its photos twice, first at a small size."""

import dataclasses
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from jaxsfm.errors import UserError
from jaxsfm.io.pairs import LazyMatches, Pair, PairResult, describe, united
from jaxsfm.io.store import Store

SECOND_CELLS = 1 << 24
"""The cells of a second look are numbered from here on, so that a photo has keypoints of both
looks. No photo that can be decoded has as many cells."""


class Looks(NamedTuple):
    """Where the matches of a run's pairs are."""

    first: Store
    second: Store | None = None
    """None: there was no second look."""
    again: Collection[Pair] = ()
    """The pairs of the second look. They keep their matches of the first one."""

    def load_matches(self, pair: Pair) -> PairResult | None:
        """The saved matches of a pair; None if a file is missing or damaged."""
        found = self.first.load_matches(pair)
        if found is None or self.second is None or pair not in self.again:
            return found
        again = self.second.load_matches(pair)
        if again is None:
            return None
        again = dataclasses.replace(again, cells=again.cells + np.int32(SECOND_CELLS))
        return united(found, again)

    def match_key(self, pair: Pair) -> list[str]:
        """Digests of all that the matches of a pair depend on."""
        stores = [self.first]
        if self.second is not None and pair in self.again:
            stores.append(self.second)
        return [store.match_key(pair) for store in stores]


class SavedMatches(LazyMatches):
    """The matches of pairs, read from their files when they are asked for.

    Reading raises UserError if a file is missing or damaged.
    """

    def __init__(self, looks: Looks, pairs: Iterable[Pair]) -> None:
        super().__init__(pairs)
        self._looks = looks

    def _load(self, pair: Pair) -> PairResult:
        found = self._looks.load_matches(pair)
        if found is None:
            raise UserError(
                f"--out {self._looks.first.path}: matches of {describe(pair)} are missing or "
                "damaged, so run the same command again"
            )
        return found
