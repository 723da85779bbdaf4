"""--threads holds for all libraries of a command."""

import os
import subprocess
import sys

import cv2
import pytest

from jaxsfm.io.threads import READ_ONCE, limit_threads

CODE = """
import sys, time
from jaxsfm.bench.model_options import StrechaOptions
from pathlib import Path
assert not {"jax", "numpy", "cv2"} & set(sys.modules), "a library has been imported before"
StrechaOptions(root=Path("."), threads=%d)
import cv2, jax
x = jax.numpy.ones((1024, 1024))
product = jax.jit(lambda x: x @ x)
product(x).block_until_ready()
wall, cpu = time.perf_counter(), time.process_time()
for _ in range(10):
    product(x).block_until_ready()
print((time.process_time() - cpu) / (time.perf_counter() - wall), cv2.getNumThreads())
"""


def ran(threads: int) -> list[float]:
    """Processors that JAX uses, and OpenCV's threads."""
    environment = {k: v for k, v in os.environ.items() if k not in READ_ONCE.values()}
    found = subprocess.run(
        [sys.executable, "-c", CODE % threads], env=environment, capture_output=True, text=True
    )
    assert found.returncode == 0, found.stderr
    return [float(text) for text in found.stdout.split()]


def test_one_thread_is_one_thread_for_jax_and_opencv():
    processors, opencv = ran(1)
    assert processors < 1.2 and opencv == 1


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="there is one processor")
def test_without_a_limit_opencv_has_more():
    """So the test above can fail. How many processors JAX gets depends on other processes."""
    assert ran(-1)[1] > 1


def test_a_library_that_is_loaded_is_left_alone(monkeypatch):
    """Else the number that workers get would not be that of this process."""
    monkeypatch.setenv("NPROC", "7")
    monkeypatch.setitem(sys.modules, "jax", sys.modules.get("jax"))
    limit_threads(3)
    assert os.environ["NPROC"] == "7"
    cv2.setNumThreads(-1)


@pytest.mark.parametrize("count", [-1, 0])
def test_no_limit_changes_nothing(monkeypatch, count):
    for name, variable in READ_ONCE.items():
        monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.delitem(sys.modules, name)
        monkeypatch.delenv(variable, raising=False)
    limit_threads(count)
    assert not set(READ_ONCE.values()) & set(os.environ)
