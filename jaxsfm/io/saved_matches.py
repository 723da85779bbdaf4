"""The matches of a run, which are read from their files when they are asked for."""

from collections.abc import Iterable

from jaxsfm.errors import UserError
from jaxsfm.io.pairs import LazyMatches, Pair, PairResult, describe
from jaxsfm.io.store import Store


class SavedMatches(LazyMatches):
    """The matches of pairs, read from their files when they are asked for.

    Reading raises UserError if a file is missing or damaged.
    """

    def __init__(self, store: Store, pairs: Iterable[Pair]) -> None:
        super().__init__(pairs)
        self._store = store

    def _load(self, pair: Pair) -> PairResult:
        found = self._store.load_matches(pair)
        if found is None:
            raise UserError(
                f"--out {self._store.path}: matches of {describe(pair)} are missing or "
                "damaged, so run the same command again"
            )
        return found
