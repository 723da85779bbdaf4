"""The style of the public functions is itself a test."""

import importlib
import importlib.metadata
import inspect
import pkgutil
import subprocess
import sys

import pytest

import jaxsfm
import jaxsfm.core

CORE = [
    importlib.import_module(f"jaxsfm.core.{m.name}")
    for m in pkgutil.iter_modules(jaxsfm.core.__path__)
]
FUNCTIONS = [
    function
    for module in CORE
    for name, function in vars(module).items()
    if callable(function)
    and not name.startswith("_")
    and getattr(function, "__module__", None) == module.__name__
    and not inspect.isclass(function)
]


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f"{f.__module__}.{f.__name__}")
def test_core_functions_are_documented_with_keyword_only_defaults(function):
    function = inspect.unwrap(function)
    assert inspect.getdoc(function)
    parameters = inspect.signature(function).parameters
    for parameter in parameters.values():
        if parameter.default is not inspect.Parameter.empty:
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, parameter
    names = list(parameters)
    assert "rng" not in names and "key" not in names[1:]


@pytest.mark.parametrize("name", sorted(jaxsfm._HOME))
def test_every_public_name_exists_and_is_documented(name):
    assert inspect.getdoc(getattr(jaxsfm, name))


def test_the_version_is_that_of_the_installation():
    assert jaxsfm.__version__ == importlib.metadata.version("jaxsfm")


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        jaxsfm.nonsense  # noqa: B018


def test_the_core_needs_jax_flax_and_jaxtyping_alone():
    """On accelerator machines jax, flax and jaxtyping must be enough. JAX brings numpy and scipy.

    Counted is what our own modules import. What flax imports in turn is its own affair.
    """
    code = """
import builtins, sys
real, foreign = builtins.__import__, set()
def imported(name, globals=None, locals=None, fromlist=(), level=0):
    if level == 0 and (globals or {}).get("__name__", "").partition(".")[0] == "jaxsfm":
        foreign.add(name.partition(".")[0])
    return real(name, globals, locals, fromlist, level)
builtins.__import__ = imported
import importlib, pkgutil, jaxsfm.core
for module in pkgutil.iter_modules(jaxsfm.core.__path__):
    importlib.import_module(f"jaxsfm.core.{module.name}")
print(sorted(foreign - set(sys.stdlib_module_names) - {"jaxsfm"}))
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert eval(done.stdout) == ["flax", "jax", "jaxtyping", "numpy", "scipy"]


def test_public_modules_stay_readable():
    """100-200 lines are the norm; past 300 two things share a file."""
    import pathlib

    for file in pathlib.Path(jaxsfm.__file__).parent.rglob("*.py"):
        assert len(file.read_text().splitlines()) <= 320, file
