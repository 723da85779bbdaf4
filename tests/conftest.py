"""Strict type promotion in every test, and the inputs that several packages' tests share."""

import atexit
import gc
import json
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # two workers, one GPU
# Programs do not name the lines that they come from: 83 tests of the core take 107 s, not 123 s.
os.environ.setdefault("JAX_INCLUDE_FULL_TRACEBACKS_IN_LOCATIONS", "0")
# Compiled programs are shared by the workers and the processes that tests start (a notebook takes
# 30 s instead of 72 s). They are not shared with the user's own cache: each session has a new one.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxsfm-compiled-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
    # Compiling is most of what tests do, and without optimization it takes a fifth of the time
    # (12 s instead of 54 s for five programs of the core). Only rounding differs. Tests of laws of
    # rounding have the mark `optimized`, and run with optimized programs.
    if os.environ.get("JAXSFM_TESTS_OPTIMIZED") != "1":
        flags = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
        # A flag that XLA does not know ends the process. jaxlib 0.11.0 knows this one, 0.11.2 not.
        if version("jaxlib").startswith(("0.10.", "0.11.0")):
            flags.append("--xla_cpu_use_fusion_emitters=false")
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags])

if "PYTEST_XDIST_WORKER_COUNT" in os.environ and hasattr(os, "sched_setaffinity"):
    # Each worker keeps to its share of the cores: two that each use all of them wait for each other
    # (the tests of sfm take 138 s instead of 152 s on two cores).
    workers, own = (os.environ[f"PYTEST_XDIST_WORKER{end}"] for end in ("_COUNT", ""))
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[int(own[2:]) :: int(workers)] or cores)

import jax
import numpy as np
import pytest
from shared import once

jax.config.update("jax_numpy_dtype_promotion", "strict")

DATA = Path(os.environ.get("JAXSFM_DATA", Path(__file__).parents[2] / "shared" / "data"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests with the mark `optimized` need optimized programs, and are skipped without them."""
    if os.environ.get("JAXSFM_TESTS_OPTIMIZED") == "1":
        return
    without = pytest.mark.skip(reason="set JAXSFM_TESTS_OPTIMIZED=1, as `make test` does")
    for item in items:
        if item.get_closest_marker("optimized"):
            item.add_marker(without)


MAPS = Path("/proc/self/maps")
MOST_MAPS = 20_000
"""Linux allows a process 65,530 mapped regions, and each compiled program takes several. A worker
that had run nearly all tests came to 64,700: its next compilation failed, and it hung."""


@pytest.fixture(autouse=True, scope="module")
def _few_programs() -> Iterator[None]:
    """After a module, compiled programs are given up when they have become many.

    What is left is no garbage, as JAX keeps programs. The collector does not look at it again: each
    of its full rounds took seconds in a process that had run many tests, and tests of the network
    took 19 s there instead of 4 s.
    """
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
    gc.freeze()


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture
def data_folder() -> Path:
    """The folder of real images with ground truth (JAXSFM_DATA, default ../shared/data)."""
    if not (DATA / "strecha").is_dir():
        pytest.skip(f"no real data in {DATA}: set JAXSFM_DATA to its folder")
    return DATA


@pytest.fixture(scope="session")
def weights():
    from jaxsfm.io.weights import load_weights

    return load_weights()


@pytest.fixture(scope="session")
def photos() -> list[np.ndarray]:
    """Real photographs from the scikit-image package, uint8 RGB."""
    from jaxsfm.bench.synthetic import photo_textures

    return photo_textures()


@pytest.fixture(scope="session")
def rendered():
    """A rendered room as a model with exact points (`room_scene.Room`)."""
    from room_scene import rendered_room

    return rendered_room()


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Iterator[Path]:
    """Three small views of the room, the middle one at night; K.txt and reference/ beside them."""
    from jaxsfm.bench.synthetic import write_scene

    def make(folder: Path) -> None:
        write_scene(folder, num_views=3, size=(320, 240))

    with once(tmp_path_factory, "scene", make) as folder:
        yield folder


@pytest.fixture
def server(monkeypatch):
    """A web server on this machine (`local_server`)."""
    from local_server import CONTENT, Handler, Server

    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with Server(("127.0.0.1", 0), Handler) as made:
        made.files, made.asked = {"/file": CONTENT}, []
        threading.Thread(target=made.serve_forever, daemon=True).start()
        yield made
        made.shutdown()


@pytest.fixture(scope="session")
def plain(scene, tmp_path_factory) -> Iterator[tuple[Path, dict]]:
    """A run of the scene with known intrinsics, and its report."""
    from jaxsfm.cli.main import main

    def make(folder: Path) -> None:
        out, known = str(folder / "out"), str(scene / "K.txt")
        args = [str(scene / "images"), "--out", out, "--intrinsics", known, "--threads", "1"]
        assert main(["reconstruct", *args]) == 0

    with once(tmp_path_factory, "plain", make) as folder:
        yield folder / "out", json.loads((folder / "out" / "report.json").read_text())


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium without a network beyond this machine.

    It ends with its module: a viewer that stays open draws on, and took a third of a core from all
    tests that came after it.
    """
    from chromium import started

    with started() as driver:
        yield driver
