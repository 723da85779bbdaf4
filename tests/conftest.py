"""Strict numerics for every test, and the inputs that several tests share."""

import atexit
import json
import os
import shutil
import tempfile
import threading
from pathlib import Path

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # two workers, one GPU
# Compiled programs are shared by the workers and the processes that tests start (a notebook's 72 s
# become 30), but not with the user's own cache: it is new for every session.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxsfm-compiled-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

import jax
import numpy as np
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")

DATA = Path(os.environ.get("JAXSFM_DATA", Path(__file__).parents[2] / "shared" / "data"))


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
    """Real photographs, uint8 RGB, from a package."""
    from jaxsfm.bench.synthetic import photo_textures

    return photo_textures()


@pytest.fixture(scope="session")
def rendered():
    """See `room_scene.Room`."""
    from room_scene import rendered_room

    return rendered_room()


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """Three small views of the room, the middle one at night; K.txt and reference beside them."""
    folder = tmp_path_factory.mktemp("scene")
    from jaxsfm.bench.synthetic import write_scene

    write_scene(folder, num_views=3, size=(320, 240))
    return folder


@pytest.fixture
def server(monkeypatch):
    """See `local_server`."""
    from local_server import CONTENT, Handler, Server

    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with Server(("127.0.0.1", 0), Handler) as made:
        made.files, made.asked = {"/file": CONTENT}, []
        threading.Thread(target=made.serve_forever, daemon=True).start()
        yield made
        made.shutdown()


@pytest.fixture(scope="session")
def plain(scene, tmp_path_factory) -> tuple[Path, dict]:
    """A run of the scene with known intrinsics and its report; tests do not write to it."""
    from jaxsfm.cli.main import main

    out = tmp_path_factory.mktemp("plain") / "out"
    args = [str(scene / "images"), "--out", str(out), "--intrinsics", str(scene / "K.txt")]
    assert main(["reconstruct", *args, "--threads", "1"]) == 0
    return out, json.loads((out / "report.json").read_text())


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium without a network beyond this machine."""
    from chromium import started

    with started() as driver:
        yield driver
