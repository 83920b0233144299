"""Worst and best cost of a policy whose rows are only known to lie in intervals.

The worst row for V gives every successor its least probability and the rest to those of the largest
V first (the ordering argument). Between such rows and the exact value of the chain that they make,
Newton's method goes up to the worst case in a few steps: it is policy iteration of an opponent who
chooses the rows. What it finds is repaired to satisfy the inequalities, and judged by others.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.certificate import interval_checks
from lmdsl.certificate.interval_checks import IntervalRows
from lmdsl.certificate.sums import UNIT
from lmdsl.common.types import Floats, Guard

LEAST_MARGIN = 0.5  # of w: it is about 1 where w is what it should be
MOST_STEPS, CLOSE, TRIES = 200, 1e-11, 8


@dataclass(frozen=True, eq=False)
class Bounds:
    """Proved bounds of the cost of one policy over all rows of intervals, shape (n,) each.

    ``high`` is infinite and ``low`` 0 where it is not proved that the cost is finite for all rows.
    """

    low: Floats
    high: Floats

    @property
    def finite(self) -> bool:
        """Whether every chain of the intervals is stabilized, at a bounded cost."""
        return bool(np.isfinite(self.high).all())


def bounds(
    rows: IntervalRows,
    G: Floats,
    factor: float,
    growth: float,
    guard: Guard | None = None,
    below: bool = True,
) -> Bounds:
    """Return bounds of the cost of a policy.

    Parameters
    ----------
    rows
        A row for each cell of C.
    G
        The stage cost of the policy, shape (n,).
    factor, growth
        gamma and max(gamma, 1), each times the discount.
    guard
        Called now and then; it may raise.
    below
        Whether the lower bound is asked for; else it is 0.
    """
    n = rows.columns
    nothing = Bounds(np.zeros(n), np.full(n, np.inf))
    up, down = factor * (1 + 2 * UNIT), factor * (1 - 2 * UNIT)  # rounded outward
    growth *= 1 + 2 * UNIT
    w = _value(rows, np.ones(n), growth, 1.0, guard)
    V = None if w is None else _value(rows, G, up, 1.0, guard)
    if w is None or V is None:
        return nothing
    t = _threshold(rows, w, 1.0)
    margin = w - growth * interval_checks.most(rows, _padded(w), t)
    if not interval_checks.is_above(rows, np.full(n, LEAST_MARGIN), growth, w, t).all():
        return nothing
    high = _lifted(rows, G, up, V, w, float(margin.min()))
    if high is None:
        return nothing
    V = _value(rows, G, down, -1.0, guard) if below else None
    low = None if V is None else _lowered(rows, G, down, V, w, float(margin.min()))
    return Bounds(np.zeros(n) if low is None else low, high)


def of_one_chain(rows: IntervalRows, G: Floats, factor: float) -> Floats | None:
    """Return about the cost of one chain, a bad one: the worst is no less. None: not finite."""
    return _solved(rows, _extreme(rows, G, 1.0)[0], G, factor)


def _padded(V: Floats) -> Floats:
    return np.append(V, 0.0)


def _value(
    rows: IntervalRows, G: Floats, factor: float, sign: float, guard: Guard | None
) -> Floats | None:
    """Return the worst value (sign 1) or the best (-1), nearly; None where it is not finite."""
    V = G.astype(np.float64)
    for _ in range(MOST_STEPS):
        if guard is not None:
            guard()
        found = _solved(rows, _extreme(rows, V, sign)[0], G, factor)
        if found is None:
            return None
        done = np.abs(found - V).max(initial=0.0) <= CLOSE * np.abs(found).max(initial=0.0)
        V = found
        if done:
            break
    return np.maximum(V, 0.0)


def _extreme(rows: IntervalRows, V: Floats, sign: float) -> tuple[Floats, Floats]:
    """Return the rows of extreme p'V, entry by entry, and the value at which each runs out."""
    value = _padded(V)[rows.target]
    owner, start = rows.owner, rows.pointer[:-1]
    order = np.lexsort((-sign * value, owner))
    room = (rows.high - rows.low)[order]
    left = 1.0 - np.add.reduceat(rows.low, start)
    before = np.cumsum(room) - room
    before -= before[start][owner]
    given = np.clip(left[owner] - before, 0.0, room)
    p = np.empty(len(value))
    p[order] = rows.low[order] + given
    last = np.maximum.reduceat(np.where(before <= left[owner], np.arange(len(order)), -1), start)
    return p, value[order][np.maximum(last, start)]


def _threshold(rows: IntervalRows, V: Floats, sign: float) -> Floats:
    return _extreme(rows, V, sign)[1]


def _solved(rows: IntervalRows, p: Floats, G: Floats, factor: float) -> Floats | None:
    """Return the value of a chain; None where it is not finite and >= 0."""
    from scipy.sparse import csc_array, csr_array, eye_array
    from scipy.sparse.linalg import splu

    n = rows.columns
    whole: Any = csr_array((p, rows.target, rows.pointer), shape=(n, n + 1))
    try:
        V = splu(csc_array(eye_array(n) - factor * whole[:, :n])).solve(G)
    except (RuntimeError, MemoryError):  # singular, or its factors are too large
        return None
    least = -1e-9 * float(np.abs(V).max(initial=0.0))
    return V if np.isfinite(V).all() and V.min(initial=0.0) >= least else None


def _lifted(
    rows: IntervalRows, G: Floats, factor: float, V: Floats, w: Floats, margin: float
) -> Floats | None:
    """Return V + delta w that satisfies the upper inequality."""
    for step in range(TRIES):
        t = _threshold(rows, V, 1.0)
        if interval_checks.is_above(rows, G, factor, V, t).all():
            return V
        short = G + factor * interval_checks.most(rows, _padded(V), t) - V
        V = V + (2.0**step * _little(short, V) / margin) * w
    return None


def _lowered(
    rows: IntervalRows, G: Floats, factor: float, V: Floats, w: Floats, margin: float
) -> Floats | None:
    """Return V - delta w, at least 0, that satisfies the lower inequality."""
    for step in range(TRIES):
        t = _threshold(rows, V, -1.0)
        if interval_checks.is_below(rows, G, factor, V, t).all():
            return V
        over = V - G - factor * interval_checks.least(rows, _padded(V), t)
        V = np.maximum(V - (2.0**step * _little(over, V) / margin) * w, 0.0)
    return None


def _little(short: Floats, V: Floats) -> float:
    return max(float(short.max()), 0.0) + 16 * UNIT * float(V.max(initial=0.0))
