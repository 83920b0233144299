"""Every inequality of the certificate in rational arithmetic: no rounding at all.

A double is an integer times a power of two and a transition is numerator / total, so each
inequality becomes one between integers. Written for clarity: a few microseconds per transition.
Rows may have denominators of their own; then, in the residual alone, what arrives in a cell is
rounded upwards to a multiple of 2^-FINE: a sum over all denominators would have millions of digits.
"""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Guard, Indices, Policy
from lmdsl.model.lp import StabilizationLP


class Row(NamedTuple):
    """A row: (target in C, numerator) for each entry, and the denominator of all."""

    entries: list[tuple[int, int]]
    total: int


BLOCK = 2**14  # number of rows that are read at a time
FINE = 4_000  # the residual is rounded up to a multiple of 2^-FINE where totals differ


def rows(
    lp: StabilizationLP, columns: Indices, guard: Guard | None = None
) -> Iterator[tuple[int, Row]]:
    """Yield (column, row), block by block; ``guard`` may raise."""
    shares, n = lp.rows.shares, lp.n
    for i in range(0, len(columns), BLOCK):
        if guard is not None:
            guard()
        block = columns[i : i + BLOCK]
        taken = lp.rows.take(block)
        pointer, target, code = taken.pointer.tolist(), taken.target.tolist(), taken.code.tolist()
        for k, first, last in zip(block.tolist(), pointer[:-1], pointer[1:], strict=True):
            numerator, total = shares.over(code[first:last])
            row = zip(target[first:last], numerator, strict=True)
            yield k, Row([(j, s) for j, s in row if j < n], total)


def integers(x: list[Fraction]) -> tuple[list[int], int]:
    """Return integers a and a shift s with x = a / 2^s."""
    shift = max((value.denominator.bit_length() - 1 for value in x), default=0)
    return [value.numerator * (2**shift // value.denominator) for value in x], shift


def residual(lp: StabilizationLP, rows: Iterable[Row], mu: list[Fraction]) -> Fraction:
    """Return ||m - mu + gamma P_u'mu||_1 for the rows of a policy."""
    a, shift = integers(mu)
    arrivals = _arrivals(lp, rows, a)
    rate, weight = Fraction(lp.gamma) / 2**shift, lp.weight.tolist()
    left = (abs(Fraction(weight[j]) - mu[j] + rate * x) for j, x in enumerate(arrivals))
    if lp.rows.shares.total is not None:
        return sum(left, Fraction(0))
    return Fraction(sum(-(-x.numerator * 2**FINE // x.denominator) for x in left), 2**FINE)


def _arrivals(lp: StabilizationLP, rows: Iterable[Row], a: list[int]) -> Iterator[Fraction]:
    """Return what arrives in each cell, P_u'a."""
    total = lp.rows.shares.total
    if total is not None:
        inflow = [0] * lp.n
        for i, (row, _) in enumerate(rows):
            for j, s in row:
                inflow[j] += a[i] * s
        return (Fraction(x, total) for x in inflow)
    by_total: list[dict[int, int]] = [{} for _ in range(lp.n)]
    for i, (row, own) in enumerate(rows):
        for j, s in row:
            by_total[j][own] = by_total[j].get(own, 0) + a[i] * s
    return (sum((Fraction(x, t) for t, x in part.items()), Fraction(0)) for part in by_total)


def fractions(x: Floats) -> list[Fraction]:
    """Return doubles as fractions."""
    return [Fraction(value) for value in x.tolist()]


def contraction(lp: StabilizationLP, rows: list[Row], w: list[Fraction]) -> Fraction | None:
    """Return max g (P_u w) / w exactly: below 1 it proves claim 1; None unless w > 0."""
    if not all(w):
        return None
    a, _ = integers(w)
    worst = max(
        (
            Fraction(sum(a[j] * s for j, s in row), a[i] * total)
            for i, (row, total) in enumerate(rows)
        ),
        default=Fraction(0),
    )
    return Fraction(lp.growth) * worst


def above_policy(lp: StabilizationLP, rows: list[Row], policy: Policy, V: list[Fraction]) -> bool:
    """Decide V >= gamma P_u V + G_u."""
    a, shift = integers(V)
    scale, cost = Fraction(lp.gamma), lp.cost[policy].tolist()
    return all(
        a[i] >= scale * sum(a[j] * s for j, s in row) / total + Fraction(cost[i]) * 2**shift
        for i, (row, total) in enumerate(rows)
    )


def below_all(
    lp: StabilizationLP, x: list[Fraction], cost: Floats | None, guard: Guard | None = None
) -> bool:
    """Decide x <= gamma P_a x + G_a for every surviving pair."""
    a, shift = integers(x)
    p, q = lp.gamma.as_integer_ratio()
    left, unit = [value * q for value in a], q * 2**shift
    for k, (row, total) in rows(lp, np.arange(lp.K, dtype=np.int64), guard):
        lacking = left[lp.cell[k]] * total - p * sum(a[j] * s for j, s in row)
        if lacking > 0 and (cost is None or lacking > Fraction(float(cost[k])) * (unit * total)):
            return False
    return True
