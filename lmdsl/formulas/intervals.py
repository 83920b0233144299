"""Interval arithmetic on arrays: every operation encloses what its operands can produce.

That is both the real results and the doubles computed. Sums, products and quotients of doubles are
correctly rounded, so a unit in the last place makes a bound safe; an elementary function is trusted
to FUNCTION_ULPS of them (NumPy documents less than 4), once at the end of the interval and once at
the value. An operation that may be undefined somewhere on its operands (a logarithm of a negative
number, a quotient across zero) returns the whole line: nothing is then claimed.
"""

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from lmdsl.common.types import Floats

ROUNDING: Final = 2.0**-53  # relative error of a correctly rounded operation

# Error of a computed elementary function, in units of the last place of its value.
FUNCTION_ULPS: Final = 4

TINY: Final = 2.0**-1070  # more than a few operations lose to underflow

_FUNCTION: Final = (4 * FUNCTION_ULPS + 2) * ROUNDING  # a unit is at most 2 ROUNDING of the value
_TOP: Final = 1.0 + _FUNCTION  # so far a computed sine may go
_LARGE: Final = 1e8  # argument above which it is not found out where in its period it lies


class Interval(NamedTuple):
    """Arrays of lower and upper ends; they broadcast like numbers."""

    low: Any
    high: Any

    @staticmethod
    def point(x: Any) -> "Interval":
        """Return the degenerate interval of exact numbers."""
        array = np.asarray(x, dtype=np.float64)
        return Interval(array, array)

    @property
    def midpoint(self) -> Floats:
        """A point inside."""
        return np.asarray(np.clip(self.low / 2 + self.high / 2, self.low, self.high))


def whole(like: Any) -> Interval:
    """Return the whole line, in the shape of an array."""
    return Interval(np.full(np.shape(like), -np.inf), np.full(np.shape(like), np.inf))


def outward(low: Any, high: Any) -> Interval:
    """Widen by a unit in the last place or two; what is not a number becomes the line."""
    return _widened(low, high, 2 * ROUNDING, 5e-324)


def loosened(low: Any, high: Any) -> Interval:
    """Widen the computed values of an elementary function; see the module."""
    return _widened(low, high, _FUNCTION, TINY)


def _widened(low: Any, high: Any, share: float, least: float) -> Interval:
    return Interval(
        _moved(low, share, least, np.subtract, -np.inf), _moved(high, share, least, np.add, np.inf)
    )


def _moved(end: Any, share: float, least: float, move: np.ufunc, bound: float) -> Floats:
    """Return an end moved by a share of itself and at least so much, ``bound`` for NaN."""
    end = np.asarray(end, dtype=np.float64)
    by: Floats = np.empty_like(end)
    np.abs(end, out=by)
    by *= share
    by += least
    move(end, by, out=by)
    (np.fmax if bound < 0 else np.fmin)(by, bound, out=by)  # which drop what is not a number
    return by


def magnitude(a: Interval) -> Any:
    """Return the largest |x| of an interval."""
    return np.maximum(np.abs(a.low), np.abs(a.high))


def mignitude(a: Interval) -> Any:
    """Return the least |x| of an interval."""
    across = (a.low <= 0) & (a.high >= 0)
    return np.where(across, 0.0, np.minimum(np.abs(a.low), np.abs(a.high)))


def either(condition: Any, a: Interval, b: Interval) -> Interval:
    """Return a where the condition holds, else b."""
    return Interval(np.where(condition, a.low, b.low), np.where(condition, a.high, b.high))


def hull(a: Interval, b: Interval) -> Interval:
    """Return the smallest interval that holds both."""
    return Interval(np.minimum(a.low, b.low), np.maximum(a.high, b.high))


def intersection(a: Interval, b: Interval) -> Interval:
    """Return what two enclosures of the same number have in common."""
    return Interval(np.maximum(a.low, b.low), np.minimum(a.high, b.high))


def add(a: Interval, b: Interval) -> Interval:
    """Return a + b; a + 0 is exact."""
    return _exact(a, b, _exact(b, a, _summed(a.low + b.low, a.high + b.high)))


def subtract(a: Interval, b: Interval) -> Interval:
    """Return a - b; a - 0 is exact."""
    return _exact(a, b, _summed(a.low - b.high, a.high - b.low))


def _exact(a: Interval, b: Interval, value: Interval) -> Interval:
    """Return a where b is 0, else a value: what does not move stays in its cell."""
    zero = _is_zero(b)
    return either(zero, a, value) if np.any(zero) else value


def _summed(low: Any, high: Any) -> Interval:
    """Widen sums: those so small that a unit in the last place vanishes are exact, 0 stays 0."""
    return _widened(low, high, 2 * ROUNDING, 0.0)


def negative(a: Interval) -> Interval:
    """Return -a."""
    return Interval(-a.high, -a.low)


def multiply(a: Interval, b: Interval) -> Interval:
    """Return a b, with 0 times infinity = 0: an end at infinity is a bound, not a value."""
    left, right = (x[:1] if x.low is x.high else x for x in (a, b))  # points have one end
    products = [np.asarray(x * y) for x in left for y in right]
    if any(np.isnan(p).any() for p in products):
        products = [np.where(np.isnan(p), 0.0, p) for p in products]
    low, high = products[0], products[0]
    for p in products[1:]:
        low, high = np.minimum(low, p), np.maximum(high, p)
    value = outward(low, high)
    positive = (a.low >= 0) & (b.low >= 0)  # so that the root of a sum of squares is defined
    value = Interval(np.where(positive, np.maximum(value.low, 0.0), value.low), value.high)
    zero = _is_zero(a) | _is_zero(b)  # 0 stays 0: what does not depend on a variable has no slope
    return either(zero, Interval.point(0.0), value) if np.any(zero) else value


def _is_zero(a: Interval) -> Any:
    return (a.low == 0) & (a.high == 0)


def square(a: Interval) -> Interval:
    """Return a^2, which is never negative."""
    return even(a, np.square, outward)


def even(a: Interval, function: Callable[[Any], Any], widen: Callable[..., Interval]) -> Interval:
    """Return f(a) of an even function that grows with |a| from f(0) >= 0."""
    near, far = function(mignitude(a)), function(magnitude(a))
    value = widen(near, far)
    return Interval(np.maximum(value.low, 0.0), value.high)


def divide(a: Interval, b: Interval) -> Interval:
    """Return a / b; the whole line where b may be zero."""
    inverse = outward(1.0 / b.high, 1.0 / b.low)
    zero = (b.low <= 0) & (b.high >= 0)
    quotient = multiply(a, either(zero, Interval.point(1.0), inverse))
    return either(zero, whole(quotient.low), quotient)


def increasing(
    function: Callable[[Any], Any], low: float = -math.inf, high: float = math.inf
) -> Callable[[Interval], Interval]:
    """Return the extension of an increasing function that is defined on [low, high]."""

    def extension(a: Interval) -> Interval:
        inside = (a.low >= low) & (a.high <= high)
        value = loosened(function(a.low), function(a.high))
        return either(inside, _rooted(a, function, value), whole(value.low))

    return extension


def exactly(function: Callable[[Any], Any]) -> Callable[[Interval], Interval]:
    """Return the extension of an increasing step function, which needs no widening."""
    return lambda a: Interval(np.asarray(function(a.low)), np.asarray(function(a.high)))


def _turns(a: Interval, offset: float, period: float) -> Any:
    """Return whether an interval may hold offset + k period for a whole k; errs towards yes."""
    slack = 1e-12 * (1 + magnitude(a))
    first, last = (a.low - slack - offset) / period, (a.high + slack - offset) / period
    far = ~(magnitude(a) <= _LARGE)
    return (np.floor(last) >= np.ceil(first)) | far


def sine(a: Interval) -> Interval:
    """Return sin(a)."""
    return _wave(a, np.sin, math.pi / 2)


def cosine(a: Interval) -> Interval:
    """Return cos(a)."""
    return _wave(a, np.cos, 0.0)


def _wave(a: Interval, function: Callable[[Any], Any], top: float) -> Interval:
    ends = function(a.low), function(a.high)
    value = loosened(np.minimum(*ends), np.maximum(*ends))
    low = np.where(_turns(a, top - math.pi, 2 * math.pi), -_TOP, value.low)
    high = np.where(_turns(a, top, 2 * math.pi), _TOP, value.high)
    return _rooted(a, function, Interval(np.maximum(low, -_TOP), np.minimum(high, _TOP)))


def tangent(a: Interval) -> Interval:
    """Return tan(a); the whole line where a pole may lie inside."""
    value = _rooted(a, np.tan, loosened(np.tan(a.low), np.tan(a.high)))
    return either(_turns(a, math.pi / 2, math.pi), whole(value.low), value)


def _rooted(a: Interval, function: Callable[[Any], Any], value: Interval) -> Interval:
    """Return 0 where a function is asked for f(0) = 0, which is exact; else a value."""
    zero = _is_zero(a)
    root = np.any(zero) and function(0.0) == 0.0
    return either(zero, Interval.point(0.0), value) if root else value


def absolute(a: Interval) -> Interval:
    """Return |a|."""
    return Interval(mignitude(a), magnitude(a))


def power(a: Interval, exponent: float) -> Interval:
    """Return a ** exponent for a constant exponent."""
    whole_number = float(exponent).is_integer()
    if exponent < 0:
        return divide(Interval.point(1.0), power(a, -exponent))
    if whole_number and exponent % 2 == 0:
        return even(a, lambda x: np.power(x, exponent), loosened)
    value = loosened(np.power(a.low, exponent), np.power(a.high, exponent))
    return value if whole_number else either(a.low >= 0, value, whole(value.low))


def angle(y: Interval, x: Interval) -> Interval:
    """Return atan2(y, x): extreme at corners unless the box meets the cut or the origin."""
    corners = [np.arctan2(v, u) for v in y for u in x]
    low, high = corners[0], corners[0]
    for c in corners[1:]:
        low, high = np.minimum(low, c), np.maximum(high, c)
    cut = (x.low <= 0) & (y.low <= 0) & (y.high >= 0)
    value = loosened(low, high)
    turn = loosened(np.full(np.shape(low), -math.pi), np.full(np.shape(low), math.pi))
    return either(cut, turn, value)


def floors(a: Interval, b: Interval) -> Interval:
    """Return the least and largest floor(a / b), exact for ends that are doubles.

    NaN where b may be zero, and beyond 2^50, where quotients are no longer told apart.
    """
    corners = [_floor(x, y) for x in a for y in b]  # a / b is extreme at corners
    low, high = corners[0], corners[0]
    for c in corners[1:]:
        low, high = np.minimum(low, c), np.maximum(high, c)
    sound = ((b.low > 0) | (b.high < 0)) & (np.abs(low) < _EXACT) & (np.abs(high) < _EXACT)
    return Interval(np.where(sound, low, np.nan), np.where(sound, high, np.nan))


_EXACT: Final = 2.0**50


def _floor(a: Any, b: Any) -> Any:
    rest = np.fmod(a, b)  # exact, and so is the whole number of b in a - rest but for one rounding
    return np.rint((a - rest) / b) - ((rest != 0) & (np.signbit(rest) != np.signbit(b)))


def remainder(a: Interval, b: Interval, turns: Interval) -> Interval:
    """Return mod(a, b) from the floors of a / b: a - k b where there is one, else 0 to b."""
    one = turns.low == turns.high
    bound = Interval(np.minimum(b.low, 0.0), np.maximum(b.high, 0.0))
    exact = subtract(a, multiply(Interval(*(np.where(one, k, 0.0) for k in turns)), b))
    value = either(one, intersection(exact, bound), bound)
    return either((b.low <= 0) & (b.high >= 0), whole(value.low), value)
