"""Every inequality of the certificate in rational arithmetic: no rounding at all.

A double is an integer times a power of two and a transition is numerator / total, so each
inequality becomes one between integers. Written for clarity: a few microseconds per transition.
"""

from collections.abc import Iterable, Iterator
from fractions import Fraction

import numpy as np

from lmdsl.common.types import Floats, Guard, Indices, Policy
from lmdsl.model.lp import StabilizationLP

Row = list[tuple[int, int]]

BLOCK = 2**14  # number of rows that are read at a time


def rows(
    lp: StabilizationLP, columns: Indices, guard: Guard | None = None
) -> Iterator[tuple[int, Row]]:
    """Yield (column, [(target in C, numerator), ...]), block by block; ``guard`` may raise."""
    numerator, n = lp.rows.shares.numerator, lp.n
    for i in range(0, len(columns), BLOCK):
        if guard is not None:
            guard()
        block = columns[i : i + BLOCK]
        taken = lp.rows.take(block)
        pointer, target, code = taken.pointer.tolist(), taken.target.tolist(), taken.code.tolist()
        for k, first, last in zip(block.tolist(), pointer[:-1], pointer[1:], strict=True):
            yield k, [(target[e], numerator[code[e]]) for e in range(first, last) if target[e] < n]


def integers(x: list[Fraction]) -> tuple[list[int], int]:
    """Return integers a and a shift s with x = a / 2^s."""
    shift = max((value.denominator.bit_length() - 1 for value in x), default=0)
    return [value.numerator * (2**shift // value.denominator) for value in x], shift


def residual(lp: StabilizationLP, rows: Iterable[Row], mu: list[Fraction]) -> Fraction:
    """Return ||m - mu + gamma P_u'mu||_1 for the rows of a policy."""
    a, shift = integers(mu)
    inflow = [0] * lp.n
    for i, row in enumerate(rows):
        for j, s in row:
            inflow[j] += a[i] * s
    rate = Fraction(lp.gamma) / (lp.rows.shares.total * 2**shift)
    weight = lp.weight.tolist()
    return sum(
        (abs(Fraction(weight[j]) - mu[j] + rate * inflow[j]) for j in range(lp.n)), Fraction(0)
    )


def fractions(x: Floats) -> list[Fraction]:
    """Return doubles as fractions."""
    return [Fraction(value) for value in x.tolist()]


def contraction(lp: StabilizationLP, rows: list[Row], w: list[Fraction]) -> Fraction | None:
    """Return max g (P_u w) / w exactly: below 1 it proves claim 1; None unless w > 0."""
    if not all(w):
        return None
    a, _ = integers(w)
    worst = max(
        (Fraction(sum(a[j] * s for j, s in row), a[i]) for i, row in enumerate(rows)),
        default=Fraction(0),
    )
    return Fraction(lp.growth) * worst / lp.rows.shares.total


def above_policy(lp: StabilizationLP, rows: list[Row], policy: Policy, V: list[Fraction]) -> bool:
    """Decide V >= gamma P_u V + G_u."""
    a, shift = integers(V)
    scale, total = Fraction(lp.gamma), lp.rows.shares.total
    cost = lp.cost[policy].tolist()
    return all(
        a[i] >= scale * sum(a[j] * s for j, s in row) / total + Fraction(cost[i]) * 2**shift
        for i, row in enumerate(rows)
    )


def below_all(
    lp: StabilizationLP, x: list[Fraction], cost: Floats | None, guard: Guard | None = None
) -> bool:
    """Decide x <= gamma P_a x + G_a for every surviving pair."""
    a, shift = integers(x)
    p, q = lp.gamma.as_integer_ratio()
    total = lp.rows.shares.total
    left = [value * q * total for value in a]
    unit = q * total * 2**shift
    for k, row in rows(lp, np.arange(lp.K, dtype=np.int64), guard):
        lacking = left[lp.cell[k]] - p * sum(a[j] * s for j, s in row)
        if lacking > 0 and (cost is None or lacking > Fraction(float(cost[k])) * unit):
            return False
    return True
