"""Compiled programs are kept where the user wants them."""

import os
import subprocess
import sys

import pytest

OPTION = "jax_compilation_cache_dir"
CODE = f"""
import sys
from jaxsfm.host.compiled import keep_compiled
assert "jax" not in sys.modules, "JAX was imported before its options were set"
keep_compiled()
import jax
print(jax.config.values["{OPTION}"])
"""


def chosen(**variables) -> str:
    environment = {k: v for k, v in os.environ.items() if k != OPTION.upper()} | variables
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is Linux's")
def test_programs_go_to_the_users_cache_folder(tmp_path):
    assert chosen(XDG_CACHE_HOME=str(tmp_path)) == str(tmp_path / "jaxsfm" / "compiled")


def test_a_chosen_folder_stays(tmp_path):
    assert chosen(JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == str(tmp_path)
