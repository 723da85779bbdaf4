"""The most memory that this process has held, on Linux."""

import contextlib
import re
from pathlib import Path

_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def forget_peak() -> None:
    """Count the most memory from now on; without effect on other systems."""
    with contextlib.suppress(OSError):
        _FORGET.write_text("5", encoding="ascii")  # proc(5): resets VmHWM


def peak_bytes() -> int | None:
    """The largest resident set since `forget_peak`, bytes; None where the system does not say."""
    with contextlib.suppress(OSError):
        found = re.search(r"^VmHWM:\s*(\d+) kB", _STATUS.read_text(encoding="ascii"), re.MULTILINE)
        return int(found[1]) * 1024 if found else None
    return None
