"""Problem files spoiled at random."""

from __future__ import annotations

import contextlib
import copy
import functools
import json
from pathlib import Path

import numpy as np
from random_problems import CORNER_CASES, random_problem

EXAMPLES = [
    json.loads(path.read_text())
    for path in sorted((Path(__file__).parents[2] / "examples").glob("*.json"))
]


RANDOM = 24  # random problems to spoil


FORMULAS = [
    "", " ", "x", "u", "1/0", "0/0", "x/(x - x)", "-x", "sqrt(-1)", "log(0)", "exp(1e9)",
    "1e999", "1e-999", "x**1e308", "(-8)**(1/3)", "0**-1", "9" * 400, "x" * 5000, "(" * 500,
    "(" * 500 + "x" + ")" * 500, "-" * 2000 + "x", "x" + "+x" * 2000, "x" + "**2" * 200,
    "sin(" * 100 + "x" + ")" * 100, "where(x < 0, 1/x, x)", "where(x)", "sin()", "sin(x, x)",
    "x.__class__", "__import__('os').system('true')", "open('/etc/passwd')", "lambda: 0",
    "[x for x in (1, 2)]", "x if x else 1", "x; x", "x\nx", "x\x00", "\u202ex", "\uff11", "\u00b2",
    "x == x == x", "x < 1 < 2", "not x", "x and x", "1_000", "0x10", "1j", "1e", "e", "pi", "nan",
    "inf", "None", "True", "max(x, nan)", "x @ x", "x % 0", "x // 0", "x << 999999", "f'{x}'",
    "'a' * 99999999", "9**9**9**9**9", "2.0**2.0**2.0**99", "abs", "min()", "mod(x, 0)",
]  # fmt: skip


STRINGS = [
    "", "x", "y", "u", "w", "grid", "map", "ode", "function", "standard_map", "clip", "lmdsl/1",
    "\x1b[31m", "a\nb", "\x00", "\x7f\x9b", "\u202e", "\ud800", "\udfff\ud800", "\ud83d\ude00",
    "\ufeff", "\u2028", "a" * 70, "a" * 100_000, "../../etc/passwd", "%s%n", "{0}", "inf", "nan",
]  # fmt: skip


NUMBERS = [
    0, -0.0, 1, -1, 2, 3, 0.5, 1e-320, 5e-324, 1e-9, 1e9, 1e300, 1.7976931348623157e308, -1e308,
    2**31, 2**32, 2**53 + 1, 2**63, 2**64, -(2**63), 10**12, 10**40, 10**308, 10**309, -(10**400),
    float("nan"), float("inf"), float("-inf"), True, False, None,
]  # fmt: skip


KEYS = [
    "kind", "low", "high", "cells", "points", "values", "weights", "boxes", "normal", "seed",
    "periodic", "parameters", "next", "derivative", "step", "substeps", "x", "u", "__class__",
    "model_config", "__proto__", "", "lambda", "\x1b", "\ud800", "a b", "per_axis", "density",
]  # fmt: skip


def nested(depth, leaf):
    for _ in range(depth):
        leaf = [leaf] if depth % 2 else {"x": leaf}
    return leaf


def hostile(rng):
    how = rng.integers(8)
    pools = (FORMULAS, STRINGS, NUMBERS, KEYS)
    if how < 4:
        pool = pools[how]
        return pool[rng.integers(len(pool))]
    if how == 4:
        return [[], {}, [[]], [{}], {"": {}}, [None], [[[]]], {"x": []}][rng.integers(8)]
    if how == 5:
        return nested(int(rng.choice([2, 5, 30, 31, 33, 60, 400])), 1)
    if how == 6:
        return [hostile(rng) for _ in range(rng.integers(1, 4))]
    return {KEYS[rng.integers(len(KEYS))]: hostile(rng) for _ in range(rng.integers(1, 4))}


def places(data, path=()):
    """Yield every (container, key)."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        yield data, key
        if isinstance(value, dict | list):
            yield from places(value)


def spoil_data(rng, data):
    """Return plain data with one to three changes of structure or value."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice([1, 2, 3], p=[0.75, 0.15, 0.1])):
        found = list(places(data))
        if not found:
            return data
        holder, key = found[rng.integers(len(found))]
        how = rng.integers(8)
        if how == 0:
            del holder[key]
        elif how == 1 and isinstance(holder, dict):
            holder[KEYS[rng.integers(len(KEYS))]] = holder.pop(key)
        elif how == 2 and isinstance(holder, dict):
            holder[KEYS[rng.integers(len(KEYS))]] = hostile(rng)
        elif how == 2:
            holder.append(hostile(rng))
        elif how == 3:
            other, name = found[rng.integers(len(found))]
            holder[key] = copy.deepcopy(other[name])
        elif how == 4 and isinstance(holder[key], list):
            holder[key] = holder[key] * int(rng.choice([2, 50]))
        elif how == 5 and isinstance(holder[key], int | float):
            with contextlib.suppress(OverflowError):
                holder[key] = holder[key] * [-1, 0, 1.5, 1e300][rng.integers(4)]
        elif how == 6 and isinstance(holder[key], str):
            holder[key] = spoil_text(rng, holder[key])
        else:
            holder[key] = hostile(rng)
    return data


def spoil_text(rng, text):
    at = int(rng.integers(len(text) + 1))
    piece = FORMULAS[rng.integers(len(FORMULAS))][:40] if rng.random() < 0.5 else "()+-*/,.\x1b1e"
    return text[:at] + piece + text[at + int(rng.integers(3)) :]


def spoil_bytes(rng, content):
    """Return bytes flipped, cut, doubled or added to."""
    content = bytearray(content)
    for _ in range(rng.choice([1, 2, 4], p=[0.7, 0.2, 0.1])):
        at = int(rng.integers(len(content) + 1))
        end = at + int(rng.integers(1, 30))
        how = rng.integers(7)
        if how == 0:
            del content[at:]
        elif how == 1:
            del content[at:end]
        elif how == 2:
            content[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif how == 3:
            content[at:at] = content[at:end]
        elif how == 4:
            content[at:at] = [b"[" * 300, b'{"', b"\xff\xfe", b"9" * 400, b"NaN,", b"\\ud800"][
                rng.integers(6)
            ]
        elif at < len(content):
            content[at] = rng.integers(256) if how == 5 else content[at] ^ 1 << rng.integers(8)
    return bytes(content)


@functools.cache
def random_file(seed):
    return random_problem(np.random.default_rng(seed))


def spoiled_file(rng):
    """Return the bytes of a problem file with something wrong."""
    how = rng.random()
    if how < 0.6:
        data = random_file(int(rng.integers(RANDOM)))
    elif how < 0.8:
        data = EXAMPLES[rng.integers(len(EXAMPLES))]
    else:
        data = CORNER_CASES[rng.integers(len(CORNER_CASES))]
    how = rng.random()
    if how < 0.65:
        data = spoil_data(rng, data)
    text = json.dumps(data, ensure_ascii=bool(rng.random() < 0.9))
    if how < 0.65:
        return text.encode("utf-8", "surrogatepass")
    if how < 0.72:
        return spoil_text(rng, text).encode("utf-8", "surrogatepass")
    return spoil_bytes(rng, text.encode())
