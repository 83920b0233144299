"""What a subexpression can yield on a box: values, derivatives and rounding.

A Jet says, for the real numbers F and the doubles f that any program computes by the same
operations in the same order:

  low, high   contain all values of F and of f
  slopes      by direction, an interval of the derivatives of F: {} where F is constant, None where
              nothing is known (a jump, a root at 0)
  error       at least |f - F|
"""

import math
from fractions import Fraction
from math import inf

from claim_7.intervals import (
    FUNCTIONS,
    HALF,
    STEPS,
    TINY,
    UNDEFINED,
    UP,
    WIDER,
    ZERO,
    Unclear,
    down,
    hull,
    least,
    minus,
    most,
    over,
    plus,
    raised,
    times,
    up,
    wider,
)  # fmt: skip

ROOTED = {"sin", "tan", "asin", "atan", "sinh", "tanh", "sqrt"}  # f(0) = 0, exactly


class Jet:
    """See the module."""

    __slots__ = ("error", "high", "low", "slopes")

    def __init__(self, low, high, slopes, error):
        if not (low > -inf and high < inf):  # not a number neither
            raise Unclear
        if slopes and not all(-inf < a and b < inf for a, b in slopes.values()):
            slopes = None
        if slopes is None or not error < inf:
            slopes, error = None, inf
        self.low, self.high, self.slopes, self.error = low, high, slopes, error

    @property
    def ends(self):
        """Low and high."""
        return self.low, self.high


def constant(x):
    """Return a double as it is."""
    return Jet(x, x, {}, 0.0)


def joined(a, b, left, right):
    """Return left(slope of a) + right(slope of b) by direction; None where one is unknown."""
    if a is None or b is None:
        return None
    found = {k: left(s) for k, s in a.items()}
    for k, s in b.items():
        found[k] = plus(found[k], right(s)) if k in found else right(s)
    return found


def same(s):
    """Return an interval as it is."""
    return s


def opposite(s):
    """Return -s."""
    return -s[1], -s[0]


def rounded(error, value, share=HALF):
    """Return the error of a result: what its operands bring, and its own."""
    return (error + share * most(value)) * UP + TINY


def add(a, b):
    """Return a + b."""
    value = plus(a.ends, b.ends)
    return Jet(*value, joined(a.slopes, b.slopes, same, same), rounded(a.error + b.error, value))


def subtract(a, b):
    """Return a - b."""
    return add(a, negative(b))


def negative(a):
    """Return -a."""
    slopes = a.slopes and {k: opposite(s) for k, s in a.slopes.items()}
    return Jet(-a.high, -a.low, slopes, a.error)


def multiply(a, b):
    """Return a b."""
    if a is b:
        return power(a, 2.0)
    x, y = a.ends, b.ends
    value = times(x, y)
    slopes = joined(a.slopes, b.slopes, lambda s: times(s, y), lambda s: times(s, x))
    return Jet(*value, slopes, rounded(most(x) * b.error + most(y) * a.error, value))


def divide(a, b):
    """Return a / b."""
    y = b.ends
    value = over(a.ends, y)
    slopes = joined(
        a.slopes, b.slopes, lambda s: over(s, y), lambda s: over(opposite(times(s, value)), y)
    )
    return Jet(*value, slopes, rounded((a.error + most(value) * b.error) / least(y), value))


def chained(a, value, derivative):
    """Return g(a) from its values and a function that yields its derivatives."""
    if a.slopes == {} and a.error == 0:
        return Jet(*value, {}, rounded(0.0, value, WIDER))
    try:
        rise = derivative(a.ends)
        if a.slopes is None or not (-inf < rise[0] and rise[1] < inf):
            raise Unclear
    except UNDEFINED:
        return Jet(*value, None, inf)
    slopes = {k: times(s, rise) for k, s in a.slopes.items()}
    return Jet(*value, slopes, rounded(most(rise) * a.error, value, WIDER))


def power(a, p):
    """Return a ** p for a double p."""
    return chained(a, raised(a.ends, p), lambda x: times((p, p), raised(x, p - 1)))


def general_power(a, b):
    """Return a ** b = exp(b log a), where a > 0."""
    logarithm_of_a = apply_function("log", a)
    found = apply_function("exp", multiply(b, logarithm_of_a))
    value = wider(*found.ends)
    moved = most(b.ends) / least(a.ends) * a.error + most(logarithm_of_a.ends) * b.error
    return Jet(*value, found.slopes, rounded(most(value) * moved, value, WIDER))


def apply_function(name, a):
    """Return an elementary function of a."""
    values, derivative = FUNCTIONS[name]
    exact = a.ends == ZERO and name in ROOTED
    return chained(a, ZERO if exact else values(a.ends), derivative)


def step(name, a):
    """Return floor, ceil or sign of a."""
    low, high = STEPS[name](a.low), STEPS[name](a.high)
    return Jet(low, high, {} if low == high else None, 0.0)  # f and F take the same value


def absolute(a):
    """Return |a|."""
    if a.low > 0 or a.high < 0:
        return a if a.low > 0 else negative(a)
    slopes = a.slopes and {k: times(s, (-1.0, 1.0)) for k, s in a.slopes.items()}
    return Jet(0.0, most(a.ends), slopes, a.error)


def smaller(a, b):
    """Return min(a, b)."""
    if a.high < b.low or b.high < a.low:
        return a if a.high < b.low else b
    slopes = None
    if a.slopes is not None and b.slopes is not None:
        zero = (0.0, 0.0)
        slopes = {
            k: hull(a.slopes.get(k, zero), b.slopes.get(k, zero)) for k in {*a.slopes, *b.slopes}
        }
    return Jet(min(a.low, b.low), min(a.high, b.high), slopes, max(a.error, b.error))


def larger(a, b):
    """Return max(a, b)."""
    return negative(smaller(negative(a), negative(b)))


def remainder(a, b):
    """Return mod(a, b), which has the sign of b, for a constant b."""
    if b.low != b.high or b.error or b.low == 0:
        raise Unclear
    bound = min(b.low, 0.0), max(b.low, 0.0)
    first, last = (math.floor(Fraction(x) / Fraction(b.low)) for x in a.ends)
    if first != last or abs(first) > 2**53:
        return Jet(*bound, None, inf)
    low, high = minus(a.ends, times((float(first),) * 2, b.ends))
    value = max(low, bound[0]), min(high, bound[1])
    return Jet(*value, a.slopes, rounded(a.error, value))


def angle(y, x):
    """Return atan2(y, x)."""
    if not (x.low > 0 or y.low > 0 or y.high < 0):  # the cut, or the origin
        return Jet(*wider(-math.pi, math.pi), None, inf)
    corners = [math.atan2(v, u) for v in y.ends for u in x.ends]
    value = wider(min(corners), max(corners))
    square = plus(raised(x.ends, 2.0), raised(y.ends, 2.0))
    moved = most(x.ends) * y.error + most(y.ends) * x.error
    slopes = joined(
        y.slopes, x.slopes,
        lambda s: over(times(s, x.ends), square),
        lambda s: over(opposite(times(s, y.ends)), square),
    )  # fmt: skip
    return Jet(*value, slopes, rounded(moved / least(square), value, WIDER))


def enclosure(box, centre, away):
    """Return what f can yield: the values on a box, and those of the mean value form.

    ``centre`` is the jet at a point of the box, ``away`` the box minus that point by direction.
    """
    low, high = box.ends
    if box.slopes is not None:
        mean = centre.ends
        for k, s in box.slopes.items():
            mean = plus(mean, times(s, away[k]))
        low, high = max(low, down(mean[0] - box.error)), min(high, up(mean[1] + box.error))
    return low, high
