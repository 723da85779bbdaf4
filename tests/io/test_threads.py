"""--threads holds for all libraries of a command."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from jaxsfm.cli.bench_commands import BENCHMARKS
from jaxsfm.io.libraries import READ_ONCE, limit_threads

CODE = """
import os, sys, time
if hasattr(os, "sched_setaffinity"):  # a test worker keeps to its own cores (conftest.py)
    os.sched_setaffinity(0, range(os.cpu_count()))
from jaxsfm.cli.main import main
assert main(sys.argv[1:]) == 2  # there is no such folder, which is found after the libraries' start
import cv2, jax
x = jax.numpy.ones((1024, 1024))
product = jax.jit(lambda x: x @ x)
product(x).block_until_ready()
wall, cpu = time.perf_counter(), time.process_time()
for _ in range(10):
    product(x).block_until_ready()
processors = (time.process_time() - cpu) / (time.perf_counter() - wall)
print(processors, cv2.getNumThreads(), *(os.environ.get(v, -1) for v in %s))
"""
COMMANDS = {
    "reconstruct": ["no-folder", "--out", "out"],
    "localize": ["no-photo", "--model", "no-folder"],
    "extend": ["no-folder"],
    "strecha": ["--root", "no-folder"],
    "daynight": ["--root", "no-folder"],
    "ambiguous": ["--root", "no-folder"],
}


def ran(command: str, threads: int, folder: Path) -> list[float]:
    """Processors that JAX uses, OpenCV's threads, and the variables' values, -1 for none."""
    environment = {k: v for k, v in os.environ.items() if k not in READ_ONCE.values()}
    before = ["bench"] if command in BENCHMARKS else []
    args = [*before, command, *COMMANDS[command], "--threads", str(threads)]
    found = subprocess.run(
        [sys.executable, "-c", CODE % [*READ_ONCE.values()], *args],
        env=environment,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert found.returncode == 0, found.stderr
    return [float(text) for text in found.stdout.split()]


@pytest.mark.parametrize("command", COMMANDS)
def test_one_thread_is_one_thread_for_jax_and_opencv(command, tmp_path):
    """How many processors JAX gets depends on other processes, too; the variables do not."""
    processors, opencv, *variables = ran(command, 1, tmp_path)
    assert processors < 1.2 and opencv == 1
    assert variables == [1] * len(READ_ONCE)


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="there is one processor")
def test_without_a_limit_opencv_has_more(tmp_path):
    """So the test above can fail."""
    _, opencv, *variables = ran("reconstruct", -1, tmp_path)
    assert opencv > 1 and variables == [-1] * len(READ_ONCE)


def test_a_library_that_is_loaded_is_left_alone(monkeypatch):
    """Else the number that workers get would not be that of this process."""
    for name, variable in READ_ONCE.items():
        monkeypatch.setitem(sys.modules, name, sys.modules.get(name))
        monkeypatch.setenv(variable, "7")
    threads = cv2.getNumThreads()
    limit_threads(threads + 3)
    assert {os.environ[variable] for variable in READ_ONCE.values()} == {"7"}
    assert cv2.getNumThreads() == threads


@pytest.mark.parametrize("count", [-1, 0])
def test_no_limit_changes_nothing(monkeypatch, count):
    for name, variable in READ_ONCE.items():
        monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.delitem(sys.modules, name)
        monkeypatch.delenv(variable, raising=False)
    limit_threads(count)
    assert not set(READ_ONCE.values()) & set(os.environ)
