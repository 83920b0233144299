"""Ends of intervals: outward rounding and elementary functions of one interval, compiled.

Every function takes and returns ends in plain doubles; what a bound rests on is said in
intervals.py. Least widths are normal numbers: arithmetic below them is slow.
"""

import math

import numpy as np

from lmdsl.formulas.intervals import FUNCTION_ULPS
from lmdsl.machine.kernels import kernel

UNIT = 2.0**-52  # two roundings: a correctly rounded result is less than half of it away
LEAST = 2.0**-1000
LOOSE = (4 * FUNCTION_ULPS + 2) * 2.0**-53  # see intervals.py
TOP = 1.0 + LOOSE
FAR = 1e8  # argument above which it is not found out where in its period it lies


@kernel
def down(x):  # type: ignore[no-untyped-def]
    """Return less than any real number whose rounded value is x."""
    return x - (abs(x) * UNIT + LEAST)


@kernel
def up(x):  # type: ignore[no-untyped-def]
    """Return more than any real number whose rounded value is x."""
    return x + (abs(x) * UNIT + LEAST)


@kernel
def below(x):  # type: ignore[no-untyped-def]
    """Return a lower bound of an elementary function computed as x, here or elsewhere."""
    return x - (abs(x) * LOOSE + LEAST)


@kernel
def above(x):  # type: ignore[no-untyped-def]
    """Return an upper bound of an elementary function computed as x, here or elsewhere."""
    return x + (abs(x) * LOOSE + LEAST)


@kernel
def extremes(a, b, offset):  # type: ignore[no-untyped-def]
    """Return the first whole k with (k + offset) pi in [a, b], and how many; errs towards more."""
    most = max(abs(a), abs(b))
    slack = 1e-12 * (1.0 + most)
    first = math.ceil((a - slack) * (1 / math.pi) - offset)
    count = math.floor((b + slack) * (1 / math.pi) - offset) - first + 1.0
    return first, count if most <= FAR else 2.0


@kernel
def wave(p, q, first, count):  # type: ignore[no-untyped-def]
    """Return the ends of a wave that is p and q at the ends; its even extremes are tops."""
    low, high = max(below(min(p, q)), -TOP), min(above(max(p, q)), TOP)
    even = 2.0 * math.floor(0.5 * first) == first
    low = -TOP if (count > 1.0) | ((count > 0.0) & (not even)) else low
    high = TOP if (count > 1.0) | ((count > 0.0) & even) else high
    return low, high


@kernel
def sine(a, b):  # type: ignore[no-untyped-def]
    """Return the ends of sin on [a, b]."""
    first, count = extremes(a, b, 0.5)
    p = math.sin(a)
    return wave(p, p if a == b else math.sin(b), first, count)


@kernel
def cosine(a, b):  # type: ignore[no-untyped-def]
    """Return the ends of cos on [a, b]."""
    first, count = extremes(a, b, 0.0)
    p = math.cos(a)
    return wave(p, p if a == b else math.cos(b), first, count)


@kernel
def tangent(a, b):  # type: ignore[no-untyped-def]
    """Return the ends of tan on [a, b], infinite where there may be a pole."""
    if extremes(a, b, 0.5)[1] > 0.0:
        return -np.inf, np.inf
    return below(math.tan(a)), above(math.tan(b))


@kernel
def power(a, b, p, whole, even):  # type: ignore[no-untyped-def]
    """Return the ends of x ** p for p > 0; ``whole`` and ``even`` say what p is."""
    if even:
        near = 0.0 if a <= 0.0 <= b else min(abs(a), abs(b))
        return max(below(near**p), 0.0), above(max(abs(a), abs(b)) ** p)
    if not whole and not a >= 0.0:
        return -np.inf, np.inf
    return below(a**p), above(b**p)


@kernel
def turn(a, b, c, d):  # type: ignore[no-untyped-def]
    """Return the ends of atan2 on y in [a, b], x in [c, d]."""
    if c <= 0.0 and a <= 0.0 <= b:
        return below(-math.pi), above(math.pi)
    p, q, r, s = math.atan2(a, c), math.atan2(a, d), math.atan2(b, c), math.atan2(b, d)
    return below(min(min(p, q), min(r, s))), above(max(max(p, q), max(r, s)))
