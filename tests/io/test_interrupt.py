"""Laws of interrupts: they are raised where Python runs, and noted where nobody would hear them."""

import signal

import pytest

from jaxsfm.io import interrupt

NUMBERS = pytest.mark.parametrize("number", interrupt.SIGNALS)


@NUMBERS
def test_an_interrupt_is_raised_where_python_runs(number):
    with pytest.raises(KeyboardInterrupt), interrupt.noted():
        signal.raise_signal(number)


@NUMBERS
def test_in_jaxs_garbage_collector_hook_it_is_found_later(number):
    """Python prints an exception in the hook with a traceback, and goes on."""
    from jax._src.lib import _xla_gc_callback

    def _xla_gc_callback_of_ours():
        signal.raise_signal(number)

    renamed = _xla_gc_callback_of_ours.__code__.replace(co_name=_xla_gc_callback.__code__.co_name)
    _xla_gc_callback_of_ours.__code__ = renamed
    with interrupt.noted():
        try:
            _xla_gc_callback_of_ours()
        except KeyboardInterrupt:
            pytest.fail("raised in the hook")
        with pytest.raises(KeyboardInterrupt):
            interrupt.check()
        interrupt.check()
