"""Random damage to files; each case of a fuzz test has its own seed and can be repeated alone."""

import copy
import json
import os
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsfm.errors import UserError

SEED = int(os.environ.get("JAXSFM_FUZZ_SEED", "0"))
"""The seed of all cases. A case that fails names it."""
NUMBERS = (0, 1, -1, 2, 255, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
WORDS = (
    "nan inf -inf 1e400 -0 1e-320 9999999999999999999 0x10 1_000 ٣ é \0 \t # : , .. / a\\n".split(
        " "
    )
)
WRONG: tuple[Any, ...] = (None, True, -1, 1e308, 2**70, "", "text\n", [], {}, [[]], {"a": None})


def rng_of(kind: str, case: int) -> np.random.Generator:
    """A random generator that depends on the case alone."""
    return np.random.default_rng([SEED, zlib.crc32(kind.encode()), case])


def outcome(read: Callable[[], Any], *names: object) -> tuple[str, Any]:
    """Read an input; returns ('read', the result) or ('refused', the error's sentence).

    Args:
      names: the file or option, one of which the sentence must name.
    """
    try:
        return "read", read()
    except UserError as error:
        text = str(error)
        assert "\n" not in text and "\r" not in text, text
        assert any(str(name) in text for name in names), (names, text)
        assert len(text) < 2000, text
        return "refused", text


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Data that is cut off or has some bytes changed, mostly near the beginning."""
    if rng.random() < 0.2:
        return data[: rng.integers(len(data))]
    changed = bytearray(data)
    for _ in range(rng.integers(1, 20)):
        end = min(4096, len(data)) if rng.random() < 0.6 else len(data)
        changed[rng.integers(end)] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
    return bytes(changed)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Data with any kind of damage: noise, cuts, flipped bits, moved parts, absurd numbers."""
    kind = rng.integers(8)
    at = int(rng.integers(len(data)))
    if kind == 0:
        return rng.bytes(int(rng.integers(0, 400)))
    if kind == 1:
        return data[:at]
    if kind == 2:  # one bit
        changed = bytearray(data)
        changed[at] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    if kind == 3:  # two chunks change places
        a, b, c = sorted(int(k) for k in rng.integers(len(data), size=3))
        return data[:a] + data[b:c] + data[a:b] + data[c:]
    if kind == 4:  # a chunk twice, or gone
        a, b = sorted(int(k) for k in rng.integers(len(data), size=2))
        return data[:b] + data[a:] if rng.random() < 0.5 else data[:a] + data[b:]
    if kind == 5:  # a number, of a size or a count as it may be
        width, order = int(rng.choice([2, 4, 8])), str(rng.choice(["little", "big"]))
        at = int(rng.integers(min(len(data), 128))) if rng.random() < 0.7 else at
        number = NUMBERS[rng.integers(len(NUMBERS))] % (1 << 8 * width)
        return data[:at] + number.to_bytes(width, order) + data[at + width :]  # type: ignore[arg-type]
    if kind == 6:
        return data + rng.bytes(int(rng.integers(1, 100)))
    return mutated(data, rng)


def damaged_text(text: str, rng: np.random.Generator) -> bytes:
    """A text with words changed, moved, doubled or removed; sometimes with any other damage."""
    if rng.random() < 0.15:
        return damaged(text.encode(), rng)
    parts = text.replace("\n", " \n ").split(" ")
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(parts)))
        kind = rng.integers(4)
        if kind == 0:
            parts[at] = WORDS[rng.integers(len(WORDS))]
        elif kind == 1:
            parts[at] = parts[at] + WORDS[rng.integers(len(WORDS))]
        elif kind == 2:
            del parts[at]
        else:
            parts.insert(at, parts[int(rng.integers(len(parts)))])
        parts = parts or [""]
    return " ".join(parts).encode()


def damaged_json(value: Any, rng: np.random.Generator) -> bytes:
    """A JSON text with a value of another type or without a key; sometimes with other damage."""
    text = json.dumps(value)
    if rng.random() < 0.15:
        return damaged(text.encode(), rng)
    changed = json.loads(text)
    for _ in range(rng.integers(1, 4)):
        changed = _changed(changed, rng)
    return json.dumps(changed).encode()


def _changed(value: Any, rng: np.random.Generator) -> Any:
    if not isinstance(value, dict | list) or not value or rng.random() < 0.2:
        return copy.deepcopy(WRONG[rng.integers(len(WRONG))])
    keys = list(value) if isinstance(value, dict) else range(len(value))
    key = keys[int(rng.integers(len(keys)))]
    if rng.random() < 0.2:
        del value[key]
    else:
        value[key] = _changed(value[key], rng)
    return value
