"""Sums, products and quotients of blocks of intervals.

A row of a block is an interval for each box: shape (2, boxes), lower and upper ends. It is finite
or the whole line: an operand or a result that may not be finite makes the line, so that no NaN
hides behind a comparison. The loops have no branches, so that they run on vectors of doubles.
"""

import numpy as np

from lmdsl.formulas.compiled.ends import LEAST, UNIT
from lmdsl.machine.kernels import kernel


@kernel
def copy(t, a):  # type: ignore[no-untyped-def]
    """Fill in t = a."""
    for i in range(np.uint64(t.shape[1])):
        t[0, i], t[1, i] = a[0, i], a[1, i]


@kernel
def add(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = a + b; exact with 0, and where a unit in the last place vanishes."""
    for i in range(np.uint64(t.shape[1])):
        low, high = a[0, i] + b[0, i], a[1, i] + b[1, i]
        p, q = low - abs(low) * UNIT, high + abs(high) * UNIT
        exact = ((a[0, i] == 0.0) & (a[1, i] == 0.0)) | ((b[0, i] == 0.0) & (b[1, i] == 0.0))
        low, high = low if exact else p, high if exact else q
        sound = high - low < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def subtract(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = a - b; a - 0 is exact."""
    for i in range(np.uint64(t.shape[1])):
        low, high = a[0, i] - b[1, i], a[1, i] - b[0, i]
        p, q = low - abs(low) * UNIT, high + abs(high) * UNIT
        exact = (b[0, i] == 0.0) & (b[1, i] == 0.0)
        low, high = low if exact else p, high if exact else q
        sound = high - low < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def negative(t, a):  # type: ignore[no-untyped-def]
    """Fill in t = -a."""
    for i in range(np.uint64(t.shape[1])):
        low, high = -a[1, i], -a[0, i]
        t[0, i], t[1, i] = low, high


@kernel
def multiply(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = a b; 0 where a factor is, not negative where neither is."""
    for i in range(np.uint64(t.shape[1])):
        al, ah, bl, bh = a[0, i], a[1, i], b[0, i], b[1, i]
        p, q, r, s = al * bl, al * bh, ah * bl, ah * bh
        p, q = p if p < q else q, q if p < q else p
        r, s = r if r < s else s, s if r < s else r
        low, high = p if p < r else r, s if q < s else q
        low, high = low - (abs(low) * UNIT + LEAST), high + (abs(high) * UNIT + LEAST)
        low = 0.0 if (low < 0.0) & (al >= 0.0) & (bl >= 0.0) else low
        zero = ((al == 0.0) & (ah == 0.0)) | ((bl == 0.0) & (bh == 0.0))
        low, high = 0.0 if zero else low, 0.0 if zero else high
        sound = (ah - al) + (bh - bl) + (high - low) < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def scale(t, a, k):  # type: ignore[no-untyped-def]
    """Fill in t = k a, k a finite number."""
    for i in range(np.uint64(t.shape[1])):
        p, q = k * a[0, i], k * a[1, i]
        low, high = p if p < q else q, q if p < q else p
        low, high = low - (abs(low) * UNIT + LEAST), high + (abs(high) * UNIT + LEAST)
        least, most = a[0, i], a[1, i]
        positive = ((k >= 0.0) & (least >= 0.0)) | ((k <= 0.0) & (most <= 0.0))
        low = 0.0 if (low < 0.0) & positive else low
        zero = (k == 0.0) | ((least == 0.0) & (most == 0.0))
        low, high = 0.0 if zero else low, 0.0 if zero else high
        sound = (a[1, i] - a[0, i]) + (high - low) < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def square(t, a):  # type: ignore[no-untyped-def]
    """Fill in t = a a, which is never negative."""
    for i in range(np.uint64(t.shape[1])):
        al, ah = a[0, i], a[1, i]
        p, q = al * al, ah * ah
        low, high = p if p < q else q, q if p < q else p
        low, high = low - (low * UNIT + LEAST), high + (high * UNIT + LEAST)
        low = low if (low > 0.0) & ((al > 0.0) | (ah < 0.0)) else 0.0
        sound = (ah - al) + high < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def divide(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = a / b, the line where b may be zero."""
    for i in range(np.uint64(t.shape[1])):
        al, ah, x, y = a[0, i], a[1, i], 1.0 / b[1, i], 1.0 / b[0, i]
        apart = (b[0, i] > 0.0) | (b[1, i] < 0.0)
        x, y = x - (abs(x) * UNIT + LEAST), y + (abs(y) * UNIT + LEAST)
        p, q, r, s = al * x, al * y, ah * x, ah * y
        p, q = p if p < q else q, q if p < q else p
        r, s = r if r < s else s, s if r < s else r
        low, high = p if p < r else r, s if q < s else q
        low, high = low - (abs(low) * UNIT + LEAST), high + (abs(high) * UNIT + LEAST)
        low = 0.0 if (low < 0.0) & (al >= 0.0) & (x >= 0.0) else low
        zero = (al == 0.0) & (ah == 0.0)
        low, high = 0.0 if zero else low, 0.0 if zero else high
        sound = apart & ((ah - al) + (b[1, i] - b[0, i]) + (y - x) + (high - low) < np.inf)
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def absolute(t, a):  # type: ignore[no-untyped-def]
    """Fill in t = abs(a)."""
    for i in range(np.uint64(t.shape[1])):
        p, q = abs(a[0, i]), abs(a[1, i])
        low, high = p if p < q else q, q if p < q else p
        low = low if (a[0, i] > 0.0) | (a[1, i] < 0.0) else 0.0
        sound = high < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf


@kernel
def smaller(t, a, b):  # type: ignore[no-untyped-def]
    """Fill in t = min(a, b)."""
    for i in range(np.uint64(t.shape[1])):
        low = a[0, i] if a[0, i] < b[0, i] else b[0, i]
        high = a[1, i] if a[1, i] < b[1, i] else b[1, i]
        sound = (a[1, i] - a[0, i]) + (b[1, i] - b[0, i]) < np.inf
        t[0, i], t[1, i] = low if sound else -np.inf, high if sound else np.inf
