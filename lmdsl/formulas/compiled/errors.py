"""Bounds of the error of what is computed, for blocks of boxes: forward, operation by operation.

A bound is the upper end of a row. Where it is not known it is infinite, never NaN.
"""

import numpy as np

from lmdsl.machine.kernels import kernel

ROUNDED_UP = 1.0 + 2.0**-47  # more than some dozen sums and products lose
TINY = 2.0**-1000  # more than underflow loses


@kernel
def rounded(t, a, b, value, share):  # type: ignore[no-untyped-def]
    """Fill in the error of a result: those of its operands, and ``share`` of its own value."""
    for i in range(np.uint64(t.shape[1])):
        p, q = abs(value[0, i]), abs(value[1, i])
        e = (a[1, i] + b[1, i] + share * (p if p > q else q)) * ROUNDED_UP + TINY
        t[1, i] = e if e < np.inf else np.inf


@kernel
def moved(t, a, e):  # type: ignore[no-untyped-def]
    """Fill in e times the largest abs(a)."""
    for i in range(np.uint64(t.shape[1])):
        p, q = abs(a[0, i]), abs(a[1, i])
        x = (p if p > q else q) * e[1, i]
        t[1, i] = x if x < np.inf else np.inf


@kernel
def divided(t, a, b, divisor):  # type: ignore[no-untyped-def]
    """Fill in (a + b) over the least abs(divisor)."""
    for i in range(np.uint64(t.shape[1])):
        p, q = abs(divisor[0, i]), abs(divisor[1, i])
        apart = (divisor[0, i] > 0.0) | (divisor[1, i] < 0.0)
        e = (a[1, i] + b[1, i]) / (p if p < q else q)
        t[1, i] = e if apart & (e < np.inf) else np.inf


@kernel
def larger(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in the larger of two."""
    for i in range(np.uint64(t.shape[1])):
        t[1, i] = a[1, i] if a[1, i] > b[1, i] else b[1, i]


@kernel
def width(t, a):  # type: ignore[no-untyped-def]
    """Fill in the width of a: both what is computed and what is real lie in it."""
    for i in range(np.uint64(t.shape[1])):
        e = (a[1, i] - a[0, i]) * ROUNDED_UP
        t[1, i] = e if e < np.inf else np.inf


@kernel
def choose(t, c, a, b, both):  # type: ignore[no-untyped-def]
    """Fill in the error of a where c holds, of b where it does not, else the width of both."""
    for i in range(np.uint64(t.shape[1])):
        e = (both[1, i] - both[0, i]) * ROUNDED_UP
        e = e if e < np.inf else np.inf
        e = e if c[1, i] != 0.0 else b[1, i]
        t[1, i] = a[1, i] if c[0, i] != 0.0 else e
