"""Compiled programs are kept where the user wants them."""

import os
import subprocess
import sys
import zlib

import pytest

from jaxsfm.cli.main import main
from jaxsfm.io.libraries import announce_compilation, drop_cut_short

OPTION = "jax_compilation_cache_dir"
CODE = f"""
import sys
from jaxsfm.io.libraries import keep_compiled
assert "jax" not in sys.modules, "JAX was imported before its options were set"
keep_compiled()
import jax
print(jax.config.values["{OPTION}"])
"""
COMPILE = """
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
import jax.numpy as jnp
jax.jit(jnp.linalg.svd)(jnp.eye(3))
"""


def ran(code: str, **variables) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k != OPTION.upper()} | variables
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )


def chosen(**variables) -> str:
    return ran(CODE, **variables).stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is Linux's")
def test_programs_go_to_the_users_cache_folder(tmp_path):
    assert chosen(XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "jaxsfm" / "compiled")


def test_a_chosen_folder_stays(tmp_path):
    assert chosen(JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == str(tmp_path)


@pytest.mark.parametrize("kind", ["zlib", "zstandard"])
def test_what_a_kill_or_a_full_disk_cut_short_is_dropped_once_and_the_rest_stays(tmp_path, kind):
    compress = zlib.compress
    if kind == "zstandard":
        compress = pytest.importorskip("zstandard").ZstdCompressor().compress
    program = compress(bytes(range(256)) * 40)
    entries = {name: tmp_path / f"{name}-cache" for name in ("whole", "half", "empty", "almost")}
    for name, size in {"whole": None, "half": 50, "empty": 0, "almost": -1}.items():
        entries[name].write_bytes(program[:size])
    assert drop_cut_short(tmp_path) == 3
    assert [name for name, entry in entries.items() if entry.exists()] == ["whole"]
    # A whole entry is not read again, so that the start does not get slower with each program.
    entries["whole"].write_bytes(b"")
    os.utime(entries["whole"], (0, 0))
    assert drop_cut_short(tmp_path) == 0
    entries["half"].write_bytes(program[:50])
    assert drop_cut_short(tmp_path) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is Linux's")
def test_after_one_that_was_cut_short_a_program_compiles_again_without_a_warning(tmp_path):
    def said() -> str:
        return ran(CODE + COMPILE, XDG_CACHE_HOME=str(tmp_path)).stderr

    assert "Warning" not in said()
    entries = list((tmp_path / "jaxsfm" / "compiled").glob("*-cache"))
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:100])
    assert entries and "Warning" not in said()
    assert all(len(entry.read_bytes()) > 100 for entry in entries)


def test_only_a_run_without_kept_programs_says_that_it_compiles(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    with caplog.at_level("INFO", logger="jaxsfm"):
        announce_compilation()
        assert str(tmp_path) in caplog.text and "compiles" in caplog.text
        caplog.clear()
        (tmp_path / "one-cache").write_bytes(b"1")
        announce_compilation()
        assert not caplog.text


def test_a_command_says_it_when_its_work_begins_and_not_before(
    scene, tmp_path, monkeypatch, capsys
):
    """A refusal stays one sentence."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "empty"))
    photo = str(scene / "images" / "view0.png")
    args = ["match", photo, photo, "--preset", "paper", "--max-size", "64", "--out"]
    assert main([*args, str(tmp_path / "m.png")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    main([*args, str(tmp_path / "m.npz")])
    assert capsys.readouterr().err.count("compiles its programs") >= 1
