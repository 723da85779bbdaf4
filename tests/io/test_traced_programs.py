"""Traced programs are kept between runs, and give what the functions give."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsfm.config import preset
from jaxsfm.core.sharded import extract_batch
from jaxsfm.core.types import DenseFeatures
from jaxsfm.io import traced_programs
from jaxsfm.io.features import feature_capacity, padded_size
from jaxsfm.io.traced_programs import FOLDER, Traced
from jaxsfm.matching.execution import ONE_AT_A_TIME, select_devices
from jaxsfm.matching.extraction import extraction_settings


class Both(NamedTuple):
    """A container, as those of the core are."""

    noise: jax.Array
    scaled: jax.Array


traced: list[int] = []
"""The static argument of each trace of `noisy`."""


@functools.partial(jax.jit, static_argnames=("times",))
def noisy(key: jax.Array, both: Both, *, times: int = 1) -> Both:
    """A function with a random key, a container and a static argument."""
    traced.append(times)
    noise = jax.random.normal(key, both.noise.shape, both.noise.dtype)
    return Both(both.noise + noise, times * both.scaled)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of compiled programs; `noisy` has not been traced."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    traced.clear()
    jax.clear_caches()
    return tmp_path / FOLDER


def both(rows: int = 3) -> Both:
    return Both(np.zeros(rows, np.float32), np.arange(rows, dtype=np.float32))  # pyright: ignore


def in_a_new_process() -> Traced:
    """Without the programs that this process has in memory."""
    jax.clear_caches()
    return Traced(noisy, Both)


def test_a_kept_program_gives_what_the_function_gives_without_tracing_it(folder):
    key = jax.random.key(5)
    expected = noisy(key, both(), times=3)
    traced.clear()
    for _ in range(2):
        found = in_a_new_process()(key, both(), times=3)
        assert isinstance(found, Both)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert traced == [3] and len(list(folder.iterdir())) == 1


def test_a_process_reads_a_program_once(folder):
    function = in_a_new_process()
    function(jax.random.key(0), both())
    next(folder.iterdir()).unlink()
    function(jax.random.key(1), both())
    assert traced == [1]


@pytest.mark.parametrize(
    "change",
    ["another shape", "another type", "another static argument", "another code", "another setting"],
)
def test_what_changes_a_program_is_traced_again(folder, monkeypatch, change):
    function, arguments, static = in_a_new_process(), both(), {"times": 1}
    function(jax.random.key(0), arguments, **static)
    if change == "another shape":
        arguments = both(4)
    elif change == "another type":
        arguments = Both(*(np.float16(each) for each in arguments))  # pyright: ignore
    elif change == "another static argument":
        static = {"times": 2}
    elif change == "another code":
        function = in_a_new_process()
        monkeypatch.setattr(traced_programs, "_made_by", lambda: ("another",))
    else:
        jax.config.update("jax_default_matmul_precision", "highest")
    try:
        found = function(jax.random.key(0), arguments, **static)
    finally:
        jax.config.update("jax_default_matmul_precision", None)
    assert traced == [1, static["times"]] and len(list(folder.iterdir())) == 2
    np.testing.assert_array_equal(found.scaled, static["times"] * arguments.scaled)


def test_another_function_of_the_same_arguments_has_a_program_of_its_own(folder):
    @jax.jit
    def other(key: jax.Array, both: Both) -> Both:
        del key
        return both

    in_a_new_process()(jax.random.key(0), both())
    found = Traced(other, Both)(jax.random.key(0), both())
    np.testing.assert_array_equal(found.noise, np.zeros(3))


@pytest.mark.parametrize(
    "damage", [lambda code: code[:-9], lambda code: b"", lambda code: b"?" * 99]
)
def test_a_damaged_file_is_written_anew(folder, damage):
    in_a_new_process()(jax.random.key(0), both())
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    in_a_new_process()(jax.random.key(0), both())
    assert traced == [1, 1] and traced_programs._read(file) is not None


def test_a_folder_that_cannot_be_written_loses_nothing(folder):
    folder.write_text("not a folder")
    found = in_a_new_process()(jax.random.key(0), both(), times=2)
    np.testing.assert_array_equal(found.scaled, [0, 2, 4])


@pytest.mark.parametrize(
    "without", ["a folder", "a local folder", "one device", "a CPU", "jit", "compiled programs"]
)
def test_nothing_is_kept_without(folder, monkeypatch, without):
    if without == "a folder":
        monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    elif without == "a local folder":
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "gs://bucket/programs")
    elif without == "one device":
        monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    elif without == "a CPU":
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    jax.config.update("jax_enable_compilation_cache", without != "compiled programs")
    try:
        with jax.disable_jit(without == "jit"):
            found = in_a_new_process()(jax.random.key(0), both(), times=2)
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    np.testing.assert_array_equal(found.scaled, [0, 2, 4])
    assert not folder.exists() and traced == [2]


def test_kept_extraction_gives_the_features_of_the_function(folder, weights, photos):
    config, mesh, size = preset("paper"), select_devices(ONE_AT_A_TIME), (96, 64)
    images = np.zeros((1, *padded_size(size), 3), np.uint8)
    images[0, :64, :96] = photos[0][:64, :96]
    sizes = np.asarray([[64, 96]], np.int32)
    settings = extraction_settings(weights, config, feature_capacity(size).num_coarse)
    arguments = weights.params, weights.scores(config), images, sizes
    expected = extract_batch(*arguments, mesh=mesh, settings=settings)
    for _ in range(2):
        kept = Traced(extract_batch, DenseFeatures)
        found = kept(*arguments, mesh=mesh, settings=settings)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert len(list(folder.iterdir())) == 1


def test_the_code_of_every_module_of_the_core_fixes_a_program(tmp_path, monkeypatch):
    """A change anywhere in the core, or a new module, gives new programs."""
    import jaxsfm.core

    def made_by() -> tuple[str, ...]:
        traced_programs._made_by.cache_clear()
        return traced_programs._made_by()

    before = made_by()
    (tmp_path / "deep").mkdir()
    monkeypatch.setattr(jaxsfm.core, "__path__", [str(tmp_path)])
    (tmp_path / "deep" / "module.py").write_text("A = 1")
    first = made_by()
    (tmp_path / "deep" / "module.py").write_text("A = 2")
    assert len({before, first, made_by()}) == 3
    traced_programs._made_by.cache_clear()


def test_64_bits_are_another_program(folder):
    in_a_new_process()(jax.random.key(0), both())
    with jax.enable_x64(True):
        in_a_new_process()(jax.random.key(0), both())
        wide = Both(*(np.float64(each) for each in both()))  # pyright: ignore
        assert in_a_new_process()(jax.random.key(0), wide).scaled.dtype == jnp.float64
    assert len(list(folder.iterdir())) == 3
