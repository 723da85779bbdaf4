"""Traced programs are kept between runs, and give what the functions give."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_calls import calls

import jaxsfm.core
from jaxsfm.io import traced_programs
from jaxsfm.io.traced_programs import FOLDER, Traced, code_of_core
from jaxsfm.matching import extraction, pair_matching
from jaxsfm.sfm.refine import patch_alignment


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


class Unnamed(NamedTuple):
    """A container that is not declared."""

    x: jax.Array


@jax.jit
def unnamed(given: Unnamed) -> Unnamed:
    """A function of it."""
    return Unnamed(2 * given.x)


@pytest.fixture
def folder(tmp_path):
    """The folder of traced programs; `noisy` has not been traced."""
    option = "jax_compilation_cache_dir"
    before = getattr(jax.config, option)
    jax.config.update(option, str(tmp_path))
    traced.clear()
    jax.clear_caches()
    yield tmp_path / FOLDER
    jax.config.update(option, before)


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
    in_a_new_process()(jax.random.key(0), both())
    assert traced == [1, 1] and file.stat().st_size == len(whole)


def test_a_folder_that_cannot_be_written_loses_nothing(folder):
    folder.write_text("not a folder")
    found = in_a_new_process()(jax.random.key(0), both(), times=2)
    np.testing.assert_array_equal(found.scaled, [0, 2, 4])


@pytest.mark.parametrize(
    "without",
    ["a folder", "a local folder", "one device", "a CPU", "jit", "compiled programs", "sources"],
)
def test_nothing_is_kept_without(folder, monkeypatch, without):
    if without == "a folder":
        jax.config.update("jax_compilation_cache_dir", None)
    elif without == "a local folder":
        jax.config.update("jax_compilation_cache_dir", "gs://bucket/programs")
    elif without == "sources":
        monkeypatch.setattr(traced_programs, "_CODE", None)
        monkeypatch.setattr(traced_programs, "code_of_core", lambda: None)
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
    assert not folder.exists() and set(traced) == {2}


KEPT = {
    "align.make_templates": patch_alignment._make_templates,
    "align.align": patch_alignment._align,
    "sharded.extract_batch": extraction._extract,
    "sharded.join_everywhere": pair_matching._join,
    "sharded.match_batch": pair_matching._match,
}
"""The functions whose programs are kept."""


SLOW = "sharded.extract_batch", "sharded.match_batch"
"""Compiling these takes seconds."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in KEPT]
)
def test_a_kept_program_of_the_core_gives_what_its_function_gives(folder, monkeypatch, name):
    """Bit for bit; the second time without tracing it."""
    call = calls()[name]
    kept, static = KEPT[name], getattr(call.function, "keywords", {})
    expected = call.function(*call.args)
    for turn in range(2):
        if turn:
            monkeypatch.setattr(traced_programs.export, "export", None)
        found = Traced(kept._function, *kept._containers)(*call.args, **static)
        assert type(found) is type(expected)
        jax.tree.map(np.testing.assert_array_equal, found, expected)
        assert len(list(folder.iterdir())) == 1


def test_a_program_that_cannot_be_kept_is_traced(folder):
    """Its container has no name in files."""
    for _ in range(2):
        found = Traced(unnamed)(Unnamed(np.ones(2, np.float32)))
        np.testing.assert_array_equal(found.x, 2 * np.ones(2))
    assert not folder.exists()


def test_a_program_traced_before_the_core_was_edited_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(traced_programs, "code_of_core", lambda: "edited since")
    found = in_a_new_process()(jax.random.key(0), both(), times=2)
    np.testing.assert_array_equal(found.scaled, [0, 2, 4])
    assert not folder.exists()


def test_the_code_of_every_module_of_the_core_fixes_a_program(tmp_path, monkeypatch):
    """A change anywhere in the core, a new name or a new module gives new programs."""
    monkeypatch.setattr(jaxsfm.core, "__path__", [str(tmp_path)])
    assert code_of_core() is None
    (tmp_path / "deep").mkdir()
    seen = set()
    for name, code in (("a", "A = 1"), ("a", "A = 2"), ("b", "A = 2")):
        (tmp_path / "deep" / f"{name}.py").write_text(code)
        seen.add(code_of_core())
    (tmp_path / "deep" / "a.py").unlink()
    assert len(seen | {code_of_core()}) == 4


def test_64_bits_are_another_program(folder):
    in_a_new_process()(jax.random.key(0), both())
    with jax.enable_x64(True):
        in_a_new_process()(jax.random.key(0), both())
        wide = Both(*(np.float64(each) for each in both()))  # pyright: ignore
        assert in_a_new_process()(jax.random.key(0), wide).scaled.dtype == jnp.float64
    assert len(list(folder.iterdir())) == 3
