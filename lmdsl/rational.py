"""Exact arithmetic on the model: rows of integers, and the residual of a measure as a fraction.

A double is an integer times a power of two and a transition is numerator / total, so sums over
transitions are sums of integers.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lmdsl.lp import StabilizationLP

Row = list[tuple[int, int]]

BLOCK = 2**14
LARGEST = Fraction(sys.float_info.max)


def rounded_up(value: Fraction) -> float:
    """Return the least double that is not below a fraction."""
    if abs(value) > LARGEST:
        return math.inf if value > 0 else -sys.float_info.max
    near = float(value)
    return near if Fraction(near) >= value else float(np.nextafter(near, math.inf))


def rows(lp: StabilizationLP, columns: NDArray[np.int64]) -> Iterator[tuple[int, Row]]:
    """Yield (column, [(target in C, numerator), ...]), block by block."""
    numerator, n = lp.rows.shares.numerator, lp.n
    for i in range(0, len(columns), BLOCK):
        block = columns[i : i + BLOCK]
        taken = lp.rows.take(block)
        pointer, target, code = taken.pointer.tolist(), taken.target.tolist(), taken.code.tolist()
        for k, first, last in zip(block.tolist(), pointer[:-1], pointer[1:], strict=True):
            yield k, [(target[e], numerator[code[e]]) for e in range(first, last) if target[e] < n]


def integers(x: list[Fraction]) -> tuple[list[int], int]:
    """Return integers a and a shift s with x = a / 2^s."""
    shift = max((value.denominator.bit_length() - 1 for value in x), default=0)
    return [value.numerator * (2**shift // value.denominator) for value in x], shift


def residual(lp: StabilizationLP, policy: Iterable[Row], mu: list[Fraction]) -> Fraction:
    """Return ||m - mu + gamma P_u'mu||_1 for the rows of a policy."""
    a, shift = integers(mu)
    inflow = [0] * lp.n
    for i, row in enumerate(policy):
        for j, s in row:
            inflow[j] += a[i] * s
    rate = Fraction(lp.gamma) / (lp.rows.shares.total * 2**shift)
    weight = lp.weight.tolist()
    return sum(
        (abs(Fraction(weight[j]) - mu[j] + rate * inflow[j]) for j in range(lp.n)), Fraction(0)
    )
