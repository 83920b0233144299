"""Intervals of doubles, rounded outward.

Sums, products, quotients and square roots of doubles are correctly rounded (IEEE 754), so that the
next double outward is safe. Of elementary functions, powers included, it is assumed that they are
within 4 units in the last place, here and wherever the map is computed: 8 in all, widened by 9.
What is undefined, infinite, or may be so somewhere on an interval, raises Unclear (or an
ArithmeticError or ValueError of Python), and nothing is claimed of it.
"""

import math
from math import inf, nextafter

WIDER = 9 * 2.0**-52  # relative; a unit in the last place is at most 2^-52 of a number
TINY = 1e-300  # more than is lost to numbers below the normal ones
HALF = 2.0**-53  # relative error of a correctly rounded operation
UP = 1 + 1e-12  # more than some operations on bounds of errors lose
ZERO = (0.0, 0.0)
UNDEFINED = (ArithmeticError, ValueError)


class Unclear(ValueError):
    """Nothing can be said of a box as a whole."""


def down(x):
    """Return the double below."""
    return nextafter(x, -inf)


def up(x):
    """Return the double above."""
    return nextafter(x, inf)


def most(a):
    """Return the largest |x| of an interval."""
    return max(abs(a[0]), abs(a[1]))


def least(a):
    """Return the smallest |x| of an interval."""
    return 0.0 if a[0] <= 0 <= a[1] else min(abs(a[0]), abs(a[1]))


def plus(a, b):
    """Return a + b."""
    if a == ZERO or b == ZERO:  # exact: what does not move stays in its cell
        return b if a == ZERO else a
    return down(a[0] + b[0]), up(a[1] + b[1])


def minus(a, b):
    """Return a - b."""
    return down(a[0] - b[1]), up(a[1] - b[0])


def times(a, b):
    """Return a b."""
    if a == ZERO or b == ZERO:
        return ZERO
    corners = a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]
    return down(min(corners)), up(max(corners))


def over(a, b):
    """Return a / b, where b is nowhere 0."""
    if b[0] <= 0 <= b[1]:
        raise Unclear
    corners = a[0] / b[0], a[0] / b[1], a[1] / b[0], a[1] / b[1]
    return down(min(corners)), up(max(corners))


def wider(low, high):
    """Widen what elementary functions yield."""
    return low - (abs(low) * WIDER + TINY), high + (abs(high) * WIDER + TINY)


def hull(*intervals):
    """Return the smallest interval that holds all."""
    return min(a for a, _ in intervals), max(b for _, b in intervals)


def growing(function, low=-inf, high=inf):
    """Return what an increasing function yields, defined on [low, high]."""

    def extended(a):
        if a[0] < low or a[1] > high:
            raise Unclear
        return wider(function(a[0]), function(a[1]))

    return extended


def turns(a, offset, period):
    """Say whether an interval may hold offset + k period; errs towards yes."""
    slack = 1e-12 * (1 + most(a))
    return most(a) > 1e8 or math.floor((a[1] + slack - offset) / period) >= math.ceil(
        (a[0] - slack - offset) / period
    )


def wave(function, top):
    """Return what the sine or cosine yields; its maxima are at top + 2 k pi."""

    def extended(a):
        ends = function(a[0]), function(a[1])
        low, high = wider(min(ends), max(ends))
        if turns(a, top - math.pi, 2 * math.pi):
            low = -1 - WIDER
        if turns(a, top, 2 * math.pi):
            high = 1 + WIDER
        return low, high

    return extended


sine, cosine = wave(math.sin, math.pi / 2), wave(math.cos, 0.0)
exponential, tanh, sinh = growing(math.exp), growing(math.tanh), growing(math.sinh)
logarithm = growing(math.log, 5e-324)


def tangent(a):
    """Return tan(a)."""
    if turns(a, math.pi / 2, math.pi):
        raise Unclear
    return wider(math.tan(a[0]), math.tan(a[1]))


def root(a):
    """Return sqrt(a)."""
    if a[0] < 0:
        raise Unclear
    return max(down(math.sqrt(a[0])), 0.0), up(math.sqrt(a[1]))


def hyperbolic_cosine(a):
    """Return cosh(a)."""
    return wider(math.cosh(least(a)), math.cosh(most(a)))


def arc_cosine(a):
    """Return acos(a)."""
    if a[0] < -1 or a[1] > 1:
        raise Unclear
    return wider(math.acos(a[1]), math.acos(a[0]))


def raised(a, p):
    """Return a ** p for a double p."""
    if p == 0:
        return 1.0, 1.0
    if p == 1:
        return wider(*a)
    if not p.is_integer() and a[0] < 0:
        raise Unclear
    if a[0] <= 0 <= a[1]:
        if p < 0:
            raise Unclear
        if p % 2 == 0:
            return 0.0, wider(0.0, most(a) ** p)[1]
        low, high = wider(a[0] ** p, a[1] ** p)
        return (max(low, 0.0) if a[0] == 0 else low), high
    return wider(*hull(*((x, x) for x in (a[0] ** p, a[1] ** p))))


ONE = (1.0, 1.0)
FUNCTIONS = {  # values and derivatives
    "sin": (sine, cosine),
    "cos": (cosine, lambda a: times((-1.0, -1.0), sine(a))),
    "tan": (tangent, lambda a: plus(ONE, raised(tangent(a), 2.0))),
    "asin": (
        growing(math.asin, -1.0, 1.0), lambda a: over(ONE, root(minus(ONE, raised(a, 2.0)))),
    ),
    "acos": (arc_cosine, lambda a: over((-1.0, -1.0), root(minus(ONE, raised(a, 2.0))))),
    "atan": (growing(math.atan), lambda a: over(ONE, plus(ONE, raised(a, 2.0)))),
    "sinh": (sinh, hyperbolic_cosine),
    "cosh": (hyperbolic_cosine, sinh),
    "tanh": (tanh, lambda a: minus(ONE, raised(tanh(a), 2.0))),
    "exp": (exponential, exponential),
    "log": (logarithm, lambda a: over(ONE, a)),
    "sqrt": (root, lambda a: over(ONE, times((2.0, 2.0), root(a)))),
}  # fmt: skip
STEPS = {
    "floor": lambda x: float(math.floor(x)), "ceil": lambda x: float(math.ceil(x)),
    "sign": lambda x: float((x > 0) - (x < 0)),
}  # fmt: skip
