"""Workers on Ray: found or started, given work piece by piece, replaced when they are lost.

Nothing here knows of images or pairs. This process hands out pieces and takes results; a worker
keeps what all its pieces need (weights on its device, compiled programs). The module is loaded in
the workers before JAX is, and must not import it.
"""

import contextlib
import itertools
import logging
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.compiled_programs import keep_compiled
from jaxsfm.io.versions import package_versions
from jaxsfm.matching.ray.cluster import connected, threads, wanted

if TYPE_CHECKING:
    from types import ModuleType

AHEAD = 2
"""Pieces that a worker has at most: one to do and the next, so that it need not wait."""
LOSSES = 3
"""So many workers may be lost one after the other without a result, or with the same item."""
PATIENCE = 60
"""Seconds without a result after which a run without any worker says what it waits for."""
logger = logging.getLogger("jaxsfm")

Work = Callable[[Sequence[Any], Mapping[str, Any]], Iterator[tuple[Any, Any]]]
"""What workers do: from a piece's items and objects to (item, result) of every item. Sent to each
worker once; what it keeps in itself stays there from piece to piece."""


class Piece(NamedTuple):
    """Some items, and what they need."""

    items: Sequence[Hashable]
    objects: Mapping[str, Any]
    """By name references into Ray's object store; they live while somebody holds them."""


class _Worker:
    """Lives in a process of its own, which Ray starts."""

    def __init__(self) -> None:
        keep_compiled()
        self._work: Work | None = None

    def versions(self) -> dict[str, str]:
        return package_versions()

    def run(self, work: Work, items: Sequence[Any], names: Sequence[str], *objects: Any) -> Any:
        """A generator of (item, result); the first `work` is kept."""
        self._work = self._work or work
        yield from self._work(items, dict(zip(names, objects, strict=True)))


class _Slot:
    """A place for a worker: the one that is there now, and what it has been given."""

    def __init__(self, start: Callable[[], Any]) -> None:
        self._start = start
        self.begin()

    def begin(self) -> None:
        """With a new worker."""
        self.worker = self._start()
        self.greeting = self.worker.versions.remote()
        self.running: deque[tuple[Any, Piece, dict]] = deque()
        """Result streams, their pieces, and items without a result; done in this order."""

    @property
    def awaited(self) -> Any:
        """What comes from it next; None: nothing."""
        return self.greeting or (self.running[0][0] if self.running else None)


class Crew:
    """Workers of one kind of work; use `crew`."""

    def __init__(self, ray: "ModuleType", slots: list[_Slot], work: Work) -> None:
        self._ray, self._slots, self._work = ray, slots, ray.put(work)
        self._again: deque[Piece] = deque()
        self._losses: Counter[Hashable] = Counter()
        self._all_given = self._warned = False

    def __len__(self) -> int:
        """Of workers."""
        return len(self._slots)

    def put(self, value: Any) -> Any:
        """A reference to the value in the object store, for pieces."""
        return self._ray.put(value)

    def results(self, pieces: Iterable[Piece]) -> Iterator[tuple[Any, Any]]:
        """(item, result) of all items of all pieces, as they come, each once.

        Pieces are asked for as workers get room. Whatever goes wrong (Ctrl-C, an error in a
        worker): what has come is handed out first.

        Raises:
          UserError: workers with other packages, or lost too often.
          Exception: whatever the work raised.
        """
        todo = iter(pieces)
        while True:
            try:
                interrupt.check()
                self._give(todo)
                if self._all_given and not self._again:
                    if not any(slot.running for slot in self._slots):
                        return
                found = self._next()
            except BaseException:
                yield from self._come()
                raise
            yield from found

    def close(self) -> None:
        """End the workers."""
        for slot in self._slots:
            self._ray.kill(slot.worker)

    def _give(self, todo: Iterator[Piece]) -> None:
        """Pieces to the workers that have room; the one with fewest first."""
        while able := [s for s in self._slots if s.greeting is None and len(s.running) < AHEAD]:
            piece = self._again.popleft() if self._again else next(todo, None)
            if piece is None:
                self._all_given = True
                return
            slot = min(able, key=lambda s: len(s.running))
            stream = slot.worker.run.remote(
                self._work, piece.items, list(piece.objects), *piece.objects.values()
            )
            slot.running.append((stream, piece, dict.fromkeys(piece.items)))

    def _next(self) -> list[tuple[Any, Any]]:
        """Wait until something comes, and take it."""
        awaited = [(slot.awaited, slot) for slot in self._slots if slot.awaited is not None]
        ready, _ = self._ray.wait([what for what, _ in awaited], timeout=PATIENCE)
        if ready:
            return self._take(next(slot for what, slot in awaited if what is ready[0]))
        if not self._warned and all(slot.greeting is not None for slot in self._slots):
            logger.warning("waiting for Ray to start workers (are CPUs or GPUs free?)")
            self._warned = True
        return []

    def _take(self, slot: _Slot) -> list[tuple[Any, Any]]:
        """The next of a worker's results, which is there."""
        errors = self._ray.exceptions
        try:
            if slot.greeting is not None:
                _check_versions(self._ray.get(slot.greeting))
                slot.greeting = None
                return []
            stream, _, left = slot.running[0]
            reference = next(stream, None)
            if reference is None:
                slot.running.popleft()
                return []
            item, result = self._ray.get(reference)
            del left[item]
            del self._losses[slot]
            return [(item, result)]
        except errors.RayTaskError as error:
            raise (error.cause or error) from error
        except errors.RayError as error:
            self._lost(slot, error)
            return []

    def _lost(self, slot: _Slot, error: Exception) -> None:
        """Another worker in its place; what it owed is given out again."""
        blamed: list[Hashable] = [slot]
        if slot.running:
            blamed += itertools.islice(slot.running[0][2], 1)
        why = str(error).strip().partition("\n")[0]
        for each in blamed:
            self._losses[each] += 1
            if self._losses[each] > LOSSES:
                raise UserError(
                    f"Ray lost a worker {LOSSES + 1} times ({why}); what has come is kept. "
                    "Too little memory? Fewer --workers or a smaller --max-size need less"
                ) from error
        logger.warning("Ray lost a worker, another is started (%s)", why)
        for _, piece, left in slot.running:
            if left:
                self._again.append(piece._replace(items=list(left)))
        with contextlib.suppress(Exception):  # it may only be out of reach
            self._ray.kill(slot.worker)
        slot.begin()

    def _come(self) -> Iterator[tuple[Any, Any]]:
        """All that is there already."""
        for slot in self._slots:
            while slot.running and self._ray.wait([slot.running[0][0]], timeout=0)[0]:
                try:
                    found = self._take(slot)
                except Exception:  # another failure behind the one that ends the run
                    break
                yield from found


def _check_versions(theirs: dict[str, str]) -> None:
    ours = package_versions()
    for name in sorted(ours.keys() | theirs.keys()):
        if theirs.get(name) != ours.get(name):
            raise UserError(
                f"a Ray worker has {name} {theirs.get(name)}, this process {ours.get(name)}: "
                "install the same versions on all machines"
            )


@contextlib.contextmanager
def crew(work: Work, *, address: str | None, workers: int | None) -> Iterator[Crew]:
    """Workers for the block: one on each GPU of the cluster, or on CPUs as `share` says.

    Raises:
      UserError: as `connected`, or the cluster has no such number of CPUs or GPUs.
    """
    with connected(address) as ray:
        count, needs = wanted(ray, workers)
        actor = ray.remote(**needs, max_restarts=0, max_task_retries=0)(_Worker)
        environment = {"env_vars": {"NPROC": str(threads())}}

        def start() -> Any:
            return actor.options(runtime_env=environment).remote()

        made = Crew(ray, [_Slot(start) for _ in range(count)], work)
        try:
            yield made
        finally:
            made.close()
