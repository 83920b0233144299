"""Elementary functions of blocks of intervals; see arithmetic.py.

Functions are numbered in the order of NAMES; derivatives are made of them in traced.py.
"""

import math

import numpy as np

from lmdsl.formulas.compiled import ends
from lmdsl.machine.kernels import kernel

NAMES = (
    "sin", "cos", "tan", "exp", "log", "sqrt", "atan", "tanh", "sinh", "cosh", "asin", "acos",
    "floor", "ceil", "rint", "sign",
)  # fmt: skip
(SIN, COS, TAN, EXP, LOG, SQRT, ATAN, TANH, SINH, COSH, ASIN, ACOS,
 FLOOR, CEIL, RINT, SIGN) = range(len(NAMES))  # fmt: skip


@kernel
def _rooted(which):  # type: ignore[no-untyped-def]
    """Return whether a function is 0 at 0, which is exact."""
    return ((which == SIN) | (which == TAN) | (which == SQRT) | (which == ATAN) | (which == TANH)
            | (which == SINH) | (which == ASIN))  # fmt: skip


@kernel
def _wave(which, t, a):  # type: ignore[no-untyped-def]
    for i in range(t.shape[1]):
        if not a[1, i] - a[0, i] < np.inf:
            t[0, i], t[1, i] = -np.inf, np.inf
        elif which == SIN:
            t[0, i], t[1, i] = ends.sine(a[0, i], a[1, i])
        elif which == COS:
            t[0, i], t[1, i] = ends.cosine(a[0, i], a[1, i])
        else:
            t[0, i], t[1, i] = ends.tangent(a[0, i], a[1, i])


@kernel
def _rising(which, x):  # type: ignore[no-untyped-def]
    """Return an increasing function at a point; NaN where it is not defined."""
    if which == EXP:
        return math.exp(x)
    if which == LOG:
        return math.log(x) if x > 0.0 else np.nan
    if which == SQRT:
        return math.sqrt(x) if x >= 0.0 else np.nan
    if which == ATAN:
        return math.atan(x)
    if which == TANH:
        return math.tanh(x)
    if which == SINH:
        return math.sinh(x)
    if which == ASIN:
        return math.asin(x) if abs(x) <= 1.0 else np.nan
    return -math.acos(x) if abs(x) <= 1.0 else np.nan


@kernel
def _step(which, x):  # type: ignore[no-untyped-def]
    if which == FLOOR:
        return np.floor(x)
    if which == CEIL:
        return np.ceil(x)
    if which == RINT:
        return np.rint(x)
    return 1.0 if x > 0.0 else -1.0 if x < 0.0 else 0.0


@kernel
def _found(which, a, b):  # type: ignore[no-untyped-def]
    """Return the ends of a function on [a, b]; what is not a number is the line."""
    if which >= FLOOR:
        return _step(which, a), _step(which, b)
    if which == COSH:
        near = 0.0 if a <= 0.0 <= b else min(abs(a), abs(b))
        return max(ends.below(math.cosh(near)), 0.0), ends.above(math.cosh(max(abs(a), abs(b))))
    low, high = ends.below(_rising(which, a)), ends.above(_rising(which, b))
    if which == ACOS:
        return -high, -low
    never = (which == SQRT) | (which == EXP)  # negative; NaN stays NaN
    return 0.0 if never & (low < 0.0) else low, high


@kernel
def apply(which, t, a):  # type: ignore[no-untyped-def]
    """Fill in t = function(a)."""
    if which <= TAN:
        _wave(which, t, a)
    else:
        for i in range(t.shape[1]):
            low, high = -np.inf, np.inf
            if a[1, i] - a[0, i] < np.inf:
                low, high = _found(which, a[0, i], a[1, i])
            sound = high - low < np.inf
            t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf
    if _rooted(which):
        for i in range(t.shape[1]):
            if (a[0, i] == 0.0) & (a[1, i] == 0.0):
                t[0, i], t[1, i] = 0.0, 0.0


@kernel
def power(t, a, p):  # type: ignore[no-untyped-def]
    """Fill in t = a ** p for a number p > 0."""
    whole = np.floor(p) == p
    even = whole & (2.0 * np.floor(0.5 * p) == p)
    for i in range(t.shape[1]):
        low, high = -np.inf, np.inf
        if a[1, i] - a[0, i] < np.inf:
            low, high = ends.power(a[0, i], a[1, i], p, whole, even)
        sound = high - low < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def turn(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = atan2(a, b)."""
    for i in range(t.shape[1]):
        low, high = ends.turn(a[0, i], a[1, i], b[0, i], b[1, i])
        sound = (a[1, i] - a[0, i]) + (b[1, i] - b[0, i]) < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def spread(t, a):  # type: ignore[no-untyped-def]
    """Fill in t = a, widened outward by a unit or two: around a jump it is not flat."""
    for i in range(np.uint64(t.shape[1])):
        t[0, i], t[1, i] = ends.down(a[0, i]), ends.up(a[1, i])
