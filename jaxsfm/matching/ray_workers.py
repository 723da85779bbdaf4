"""A pool of workers on Ray: it hands out tasks, takes results, and replaces lost workers.

Nothing here knows of images or pairs. A worker keeps what all its tasks need (weights on its
device, compiled programs). Workers load this module before JAX, so it must not import JAX.
"""

import contextlib
import itertools
import logging
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

from jaxsfm.errors import UserError
from jaxsfm.io import interrupt
from jaxsfm.io.libraries import keep_compiled, package_versions
from jaxsfm.matching.ray_cluster import connect, worker_resources, xla_threads

if TYPE_CHECKING:
    from types import ModuleType

    from ray.actor import ActorHandle

TASKS_PER_WORKER = 2
"""Tasks that a worker has at most: one to do and the next one, so that it need not wait."""
MAX_LOSSES = 3
"""So many workers may be lost one after the other without a result, or with the same item."""
WARN_AFTER_S = 60
"""Seconds without a result after which a run without any worker says what it waits for."""
logger = logging.getLogger("jaxsfm")

Item = TypeVar("Item", bound=Hashable)
Result = TypeVar("Result")
Needed = TypeVar("Needed")
Work = Callable[[Sequence[Item], Mapping[str, Needed]], Iterator[tuple[Item, Result]]]
"""What workers do: from a task's items and objects to (item, result) of every item. It is sent to
each worker once, and what it keeps in itself stays there from task to task."""


class Task(NamedTuple, Generic[Item]):
    """Some items, and what they need."""

    items: Sequence[Item]
    objects: Mapping[str, object]
    """References into Ray's object store, by name; the objects live while somebody holds them."""


class _Worker:
    """Lives in a process of its own, which Ray starts."""

    def __init__(self) -> None:
        keep_compiled()
        self._work: Work | None = None

    def versions(self) -> dict[str, str]:
        return package_versions()

    def run(
        self, work: Work, items: Sequence[Hashable], names: Sequence[str], *objects: object
    ) -> Iterator[tuple[Hashable, object]]:
        """Yield (item, result) of every item. The first `work` is kept for all tasks."""
        self._work = self._work or work
        yield from self._work(items, dict(zip(names, objects, strict=True)))


class _Running(NamedTuple, Generic[Item]):
    """A task that a worker has."""

    stream: Iterator[object]
    """References to its results, as they are made."""
    task: Task[Item]
    left: dict[Item, None]
    """Items without a result, in the order in which they are done."""


class _Slot(Generic[Item]):
    """A place for a worker: the worker that has it now, and the tasks of that worker."""

    def __init__(self, start: "Callable[[], ActorHandle[_Worker]]") -> None:
        self._start = start
        self.begin()

    def begin(self) -> None:
        """Start a new worker here."""
        self.worker = self._start()
        self.versions: object | None = self.worker.versions.remote()
        """The worker's first answer; None once it has come."""
        self.running: deque[_Running[Item]] = deque()

    @property
    def awaited(self) -> object | None:
        """What the worker will send next; None: nothing."""
        return self.versions or (self.running[0].stream if self.running else None)


class WorkerPool(Generic[Item, Result]):
    """Workers that do one kind of work; made by `worker_pool`."""

    def __init__(self, ray: "ModuleType", slots: list[_Slot[Item]], work: Work) -> None:
        self._ray, self._slots, self._work = ray, slots, ray.put(work)
        self._again: deque[Task[Item]] = deque()
        self._losses: Counter[Hashable] = Counter()
        self._all_submitted = self._warned = False

    def __len__(self) -> int:
        """The number of workers."""
        return len(self._slots)

    def put(self, value: object) -> object:
        """Put a value into Ray's object store; returns a reference to it, for tasks."""
        return self._ray.put(value)

    def results(self, tasks: Iterable[Task[Item]]) -> Iterator[tuple[Item, Result]]:
        """Yield (item, result) of all items of all tasks, each once, as they come.

        `tasks` is asked for the next task when a worker has room for it. Whatever goes wrong
        (Ctrl-C, an error in a worker), the results that have come are yielded first.

        Raises:
          UserError: a worker has other versions of packages, or workers are lost too often.
          Exception: whatever the work raised.
        """
        todo = iter(tasks)
        while True:
            try:
                interrupt.check()
                self._submit(todo)
                if self._all_submitted and not self._again:
                    if not any(slot.running for slot in self._slots):
                        return
                found = self._next()
            except BaseException:
                yield from self._take_all()
                raise
            yield from found

    def close(self) -> None:
        """End the workers."""
        for slot in self._slots:
            self._ray.kill(slot.worker)

    def _submit(self, todo: Iterator[Task[Item]]) -> None:
        """Give tasks to the workers that have room; the worker with fewest tasks comes first."""
        while able := [
            s for s in self._slots if s.versions is None and len(s.running) < TASKS_PER_WORKER
        ]:
            task = self._again.popleft() if self._again else next(todo, None)
            if task is None:
                self._all_submitted = True
                return
            slot = min(able, key=lambda s: len(s.running))
            stream = slot.worker.run.remote(
                self._work, task.items, list(task.objects), *task.objects.values()
            )
            slot.running.append(_Running(stream, task, dict.fromkeys(task.items)))

    def _next(self) -> list[tuple[Item, Result]]:
        """Wait until a worker sends something, and take it."""
        awaited = [(slot.awaited, slot) for slot in self._slots if slot.awaited is not None]
        ready, _ = self._ray.wait([what for what, _ in awaited], timeout=WARN_AFTER_S)
        if ready:
            return self._take(next(slot for what, slot in awaited if what is ready[0]))
        if not self._warned and all(slot.versions is not None for slot in self._slots):
            logger.warning("waiting for Ray to start workers (are CPUs or GPUs free?)")
            self._warned = True
        return []

    def _take(self, slot: _Slot[Item]) -> list[tuple[Item, Result]]:
        """Take what a worker has sent: at most one result."""
        errors = self._ray.exceptions
        try:
            if slot.versions is not None:
                _check_versions(self._ray.get(slot.versions))
                slot.versions = None
                return []
            reference = next(slot.running[0].stream, None)
            if reference is None:
                slot.running.popleft()
                return []
            item, result = self._ray.get(reference)
            del slot.running[0].left[item]
            del self._losses[slot]
            return [(item, result)]
        except errors.RayTaskError as error:
            raise (error.cause or error) from error
        except errors.RayError as error:
            self._replace(slot, error)
            return []

    def _replace(self, slot: _Slot[Item], error: Exception) -> None:
        """Start another worker in place of a lost one, and keep its items to submit them again."""
        blamed: list[Hashable] = [slot]
        if slot.running:
            blamed += itertools.islice(slot.running[0].left, 1)
        why = str(error).strip().partition("\n")[0]
        for each in blamed:
            self._losses[each] += 1
            if self._losses[each] > MAX_LOSSES:
                raise UserError(
                    f"Ray lost a worker {MAX_LOSSES + 1} times ({why}); what has come is kept. "
                    "Too little memory? Fewer --workers or a smaller --max-size need less"
                ) from error
        logger.warning("Ray lost a worker, another is started (%s)", why)
        for running in slot.running:
            if running.left:
                self._again.append(running.task._replace(items=list(running.left)))
        with contextlib.suppress(Exception):  # the worker may only be out of reach
            self._ray.kill(slot.worker)
        slot.begin()

    def _take_all(self) -> Iterator[tuple[Item, Result]]:
        """Yield all results that are there already."""
        for slot in self._slots:
            while slot.running and self._ray.wait([slot.running[0].stream], timeout=0)[0]:
                try:
                    found = self._take(slot)
                except Exception:  # another failure, behind the one that ends the run
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
def worker_pool(
    work: Work[Item, Needed, Result], *, address: str | None, workers: int | None
) -> Iterator[WorkerPool[Item, Result]]:
    """Start workers that live as long as the block (`worker_resources` says how many).

    Raises UserError if Ray cannot be used (`connect`), or has too few CPUs or GPUs.
    """
    with connect(address) as ray:
        count, needs = worker_resources(ray, workers)
        actor = ray.remote(**needs, max_restarts=0, max_task_retries=0)(_Worker)
        environment = {"env_vars": {"NPROC": str(xla_threads())}}

        def start() -> "ActorHandle[_Worker]":
            return actor.options(runtime_env=environment).remote()

        pool = WorkerPool(ray, [_Slot(start) for _ in range(count)], work)
        try:
            yield pool
        finally:
            pool.close()
