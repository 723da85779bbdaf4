"""The Ray cluster that is used, how many workers it runs, and what each worker takes of it."""

import contextlib
import logging
import os
import socket
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from jaxsfm.errors import UserError
from jaxsfm.io.extras import extra
from jaxsfm.io.libraries import usable_cores

if TYPE_CHECKING:
    from types import ModuleType

ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",
}
"""Set before Ray is imported. Ray then sends no usage reports, gives no advice to developers, and
does not print between the progress bars when a worker dies (`WorkerPool` reports that itself)."""


def import_ray() -> "ModuleType":
    """Import Ray with `ENVIRONMENT`. Raises UserError if it is not installed."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    with extra("ray", "--engine ray needs"):
        import ray
    return ray


@contextlib.contextmanager
def connect(address: str | None) -> Iterator["ModuleType"]:
    """Connect to a Ray cluster for the block; yields the module `ray`.

    If this process is connected already, that connection is used. Else it is the cluster at
    `address`, or at RAY_ADDRESS, or the one that runs on this machine, or a new one that lives as
    long as the block. Raises UserError if Ray is not installed or no cluster answers.
    """
    ray = import_ray()
    if ray.is_initialized():
        yield ray
        return
    address = address or os.environ.get("RAY_ADDRESS")
    _check_answers(address)
    try:
        with warnings.catch_warnings():
            # JAX warns of forks in a process with threads; these only start Ray's programs.
            warnings.filterwarnings("ignore", r"os\.fork", RuntimeWarning)
            # Without an address Ray takes the cluster that `ray start` left on this machine, or
            # starts one.
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
    """Raise UserError unless an address answers. Ray itself would try for minutes, and print."""
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


def xla_threads() -> int:
    """The number of threads that XLA has in this process.

    Workers get the same number. XLA splits sums among its threads on CPUs, so with another number
    they would round differently: one thread and two differ in the last place of features.
    """
    given = os.environ.get("NPROC", "")
    if given.isdecimal():
        return int(given)
    return usable_cores()


def share_cpus(cpus: Sequence[int], workers: int | None, usual: int) -> tuple[int, int]:
    """How many workers there are, and how many CPUs Ray reserves for each.

    Args:
      cpus: the number of CPUs of each machine.
      workers: the number that was asked for; None: one for every `usual` CPUs of a machine, and at
        least one for each machine.
    """
    if workers is None:
        each = min(usual, *cpus)
        return sum(n // each for n in cpus), each
    for each in range(max(cpus), 0, -1):
        if sum(n // each for n in cpus) >= workers:
            return workers, each
    raise UserError(f"--workers {workers}: there are {sum(cpus)} CPUs")


def worker_resources(ray: "ModuleType", workers: int | None) -> tuple[int, dict[str, int]]:
    """How many workers there are, and what Ray reserves for each (options of `ray.remote`).

    Each worker gets a GPU if the cluster has any, and CPUs otherwise.

    Args:
      workers: the number that was asked for; None: as many as there is room for.

    Raises:
      UserError: there are too few GPUs or CPUs.
    """
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if gpus := int(sum(machine.get("GPU", 0) for machine in machines)):
        if workers is not None and workers > gpus:
            raise UserError(f"--workers {workers}: there are {gpus} GPUs")
        return workers or gpus, {"num_gpus": 1}
    cpus = [n for machine in machines if (n := int(machine.get("CPU", 0)))]
    if not cpus:
        raise UserError("--engine ray: the cluster has no CPUs for workers")
    count, each = share_cpus(cpus, workers, xla_threads())
    return count, {"num_cpus": each}
