"""A Ray cluster: the one that is there, or one of this process; what a worker takes of it."""

import contextlib
import logging
import os
import socket
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from jaxsfm.errors import UserError

if TYPE_CHECKING:
    from types import ModuleType

QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",
}
"""Ray's reports to its makers, its advice to developers, and what it would print between the
progress bars when a worker dies (we say so ourselves). To be set before it is imported."""


def imported_ray() -> "ModuleType":
    """Ray, `QUIET`.

    Raises:
      UserError: it is not installed.
    """
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise UserError("--engine ray needs Ray: pip install 'jaxsfm[ray]'") from error
    return ray


@contextlib.contextmanager
def connected(address: str | None) -> Iterator["ModuleType"]:
    """Ray, connected: to what this process is connected to already, to `address`, to a cluster
    that runs here (RAY_ADDRESS tells another), or to one that lives as long as the block.

    Raises:
      UserError: Ray is not installed, or there is no cluster at the address.
    """
    ray = imported_ray()
    if ray.is_initialized():
        yield ray
        return
    address = address or os.environ.get("RAY_ADDRESS")
    _check_answers(address)
    try:
        with warnings.catch_warnings():
            # JAX fears forks of its threads; these only become Ray's programs.
            warnings.filterwarnings("ignore", r"os\.fork", RuntimeWarning)
            # Without an address: what `ray start` left on this machine, else a cluster of its own.
            ray.init(address=address, logging_level=logging.CRITICAL, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        why = str(error).strip().partition("\n")[0]
        raise UserError(
            f"--engine ray: Ray cannot be used ({why}); a cluster with a token wants RAY_AUTH_MODE="
            "token here too"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_answers(address: str | None) -> None:
    """Ray itself would try for minutes, and print about it."""
    if address in (None, "auto", "local"):
        return
    host, _, port = address.rpartition(":")
    if "://" in address or not host or not port.isdecimal():
        raise UserError(
            f"--ray-address {address}: must be HOST:PORT of a cluster that this machine belongs to"
        )
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"--ray-address {address}: nothing answers there ({error})") from error


def threads() -> int:
    """Of XLA in this process. Sums are split among them: a worker with another number would round
    differently (on CPUs; one thread and two differ in the last place of features, measured)."""
    given = os.environ.get("NPROC", "")
    if given.isdecimal():
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share(cpus: Sequence[int], workers: int | None, usual: int) -> tuple[int, int]:
    """How many workers, and how many CPUs Ray is asked for each.

    Args:
      cpus: of each machine.
      workers: as asked for; None: one for every `usual` CPUs of a machine, at least one.

    Raises:
      UserError: there are fewer CPUs than workers.
    """
    if workers is None:
        each = min(usual, *cpus)
        return sum(n // each for n in cpus), each
    for each in range(max(cpus), 0, -1):
        if sum(n // each for n in cpus) >= workers:
            return workers, each
    raise UserError(f"--workers {workers}: there are {sum(cpus)} CPUs")


def wanted(ray: "ModuleType", workers: int | None) -> tuple[int, dict[str, int]]:
    """How many workers, and what Ray is asked for each: a GPU where the cluster has any, else CPUs.

    Raises:
      UserError: there are not so many.
    """
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if gpus := int(sum(machine.get("GPU", 0) for machine in machines)):
        if workers is not None and workers > gpus:
            raise UserError(f"--workers {workers}: there are {gpus} GPUs")
        return workers or gpus, {"num_gpus": 1}
    cpus = [n for machine in machines if (n := int(machine.get("CPU", 0)))]
    if not cpus:
        raise UserError("--engine ray: the cluster has no CPUs for workers")
    count, each = share(cpus, workers, threads())
    return count, {"num_cpus": each}
