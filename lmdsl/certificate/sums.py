"""Sums of products of doubles >= 0, rounded outward, from the smallest doubles to the largest.

Fast within a range in which nothing overflows or loses digits by underflow; exact rationals
outside.
"""

import math
import sys
from fractions import Fraction

import numpy as np

from lmdsl.common.types import Floats

UNIT = 1.1 * 2.0**-53  # relative error of a rounded operation, and a tenth
LEAST = 2.0**-1074  # the least positive double
NORMAL = sys.float_info.min  # the least double of full precision
LARGEST = Fraction(sys.float_info.max)
# Products of two numbers in between are normal doubles, and so are their rounding errors.
LOW, HIGH = 2.0**-450, 2.0**450
MOST_EXACT_TERMS = 1_000  # number of terms above which sums are made by NumPy
BITS = 2 * 1074  # binary places of a product of two doubles


def rounded_up(value: Fraction) -> float:
    """Return the least double that is not below a fraction; infinity above the largest."""
    if abs(value) > LARGEST:
        return math.inf if value > 0 else -sys.float_info.max
    near = float(value)
    return near if Fraction(near) >= value else float(np.nextafter(near, math.inf))


def rounded_down(value: Fraction) -> float:
    """Return the largest double that is not above a fraction."""
    return 0.0 - rounded_up(-value)


def total(values: Floats) -> float:
    """Return the sum of values >= 0, correctly rounded; infinite where it overflows."""
    try:
        return math.fsum(values)
    except OverflowError:
        return math.inf


def total_above(values: Floats) -> float:
    """Return an upper bound of the sum of values >= 0, the sum correctly rounded if not many."""
    if len(values) <= MOST_EXACT_TERMS:
        return total(values) * (1 + 4 * UNIT)
    # NumPy adds pairwise: fewer than 64 roundings deep.
    with np.errstate(over="ignore"):
        return float(values.sum()) * (1 + 70 * UNIT)


def exactly(weight: Floats, values: Floats) -> Fraction:
    """Return weight'values of finite values >= 0."""
    on = (weight > 0) & (values > 0)
    found = 0
    for m, v in zip(weight[on].tolist(), values[on].tolist(), strict=True):
        (a, b), (c, d) = m.as_integer_ratio(), v.as_integer_ratio()
        found += a * c << BITS + 2 - b.bit_length() - d.bit_length()
    return Fraction(found, 1 << BITS)


def weighted(weight: Floats, values: Floats, direction: float) -> float:
    """Return weight'values rounded towards ``direction`` (an infinity), for values >= 0.

    Of up to 1,000 terms it is the double nearest to the exact sum on the side asked for, by
    products split exactly (Dekker) and summed exactly; sums of more are bounded as a rule.
    """
    few = len(values) <= MOST_EXACT_TERMS
    if few and _within(weight) and _within(values):
        return _split(weight, values, direction)
    if not few and values.max() <= 2.0**1000:
        with np.errstate(over="ignore"):
            product = weight * values
            near = float(product.sum())
        if 2.0**-900 <= near <= 2.0**1000:
            # NumPy adds pairwise: fewer than 64 roundings deep, one more for each product.
            slack = 70 * UNIT * near + len(product) * LEAST
            return float(np.nextafter(near + math.copysign(slack, direction), direction))
    value = exactly(weight, values)
    return rounded_up(value) if direction > 0 else rounded_down(value)


def gap_above(weight: Floats, V: Floats, W: Floats) -> float:
    """Return weight'(V - W) / weight'V rounded up, 0 where it is negative or weight'V is 0."""
    cost = weighted(weight, V, -math.inf)
    if cost >= 2.0**-900 and V.max() <= 2.0**1000:
        width = weighted(weight, np.maximum(V - W, 0.0), math.inf)
        return float(np.nextafter(width / cost * (1 + 8 * UNIT), math.inf)) if width else 0.0
    exact = exactly(weight, V)
    return max(rounded_up((exact - exactly(weight, W)) / exact), 0.0) if exact else 0.0


def mean(weight: Floats, values: Floats, direction: float) -> float:
    """Return weight'values / sum of weights, rounded towards ``direction``; infinite with a value.

    The weights are not all 0.
    """
    on = weight > 0
    m, x = weight[on], values[on]
    if not np.isfinite(x).all():
        return math.inf
    near = weighted(m, x, direction)
    if 2.0**-900 <= near <= 2.0**1000 and m.min() >= 2.0**-900:
        return near / math.fsum(m) * (1 + math.copysign(8 * UNIT, direction))
    value = exactly(m, x) / sum(map(Fraction, m.tolist()))
    return rounded_up(value) if direction > 0 else rounded_down(value)


def stated_gap(gap: float, cost: float, lower: float) -> float:
    """Return the gap that a cost and a lower bound rounded to doubles still show.

    Below the normal range doubles are so coarse that rounding may open a gap of its own.
    """
    if not 0 < cost < NORMAL:
        return gap
    return max(gap, rounded_up(1 - Fraction(lower) / Fraction(cost)))


def _within(x: Floats) -> bool:
    """Return whether every number is 0 or in the range of the fast sums."""
    return bool(((x == 0) | ((x >= LOW) & (x <= HIGH))).all())


def _split(weight: Floats, values: Floats, direction: float) -> float:
    product = weight * values
    a, b = _halves(weight), _halves(values)
    error = ((a[0] * b[0] - product) + a[0] * b[1] + a[1] * b[0]) + a[1] * b[1]
    terms = [*product.tolist(), *error.tolist()]
    near = math.fsum(terms)
    beyond = math.fsum([*terms, -near])  # what rounding to nearest left out
    outward = beyond > 0 if direction > 0 else beyond < 0
    return float(np.nextafter(near, direction)) if outward else near


def _halves(x: Floats) -> tuple[Floats, Floats]:
    """Split doubles into two of 26 bits each, whose products are exact."""
    c = 134217729.0 * x
    high = c - (c - x)
    return high, x - high
