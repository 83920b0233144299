"""Bounds over all rows of intervals, each proved by a number a row: nothing is sorted here.

The largest p'V over low <= p <= high, sum p = 1, is at most, for every number t,

    t + sum_j (high_j (V_j - t)+  -  low_j (t - V_j)+),

since p'V = t + p'(V - t); the least one is at least the same with low and high exchanged. A wrong t
makes the bound weak, never wrong. Sums are rounded outward.
"""

from dataclasses import dataclass

import numpy as np

from lmdsl.certificate.sums import LEAST, UNIT
from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, Floats, Indices

OPERATIONS = 8  # roundings of a term and of what joins it, beside its sum


@dataclass(frozen=True, eq=False)
class IntervalRows(Frozen):
    """All rows p with low <= p <= high on the entries of each row, and sum 1."""

    pointer: Indices
    target: Indices  # n is the attractor
    low: Floats
    high: Floats
    columns: int

    @property
    def owner(self) -> Indices:
        """The row of every entry, shape (E,)."""
        return np.repeat(np.arange(len(self.pointer) - 1), np.diff(self.pointer))


def most(rows: IntervalRows, V: Floats, t: Floats) -> Floats:
    """Return upper bounds of p'V, shape (rows,); V has a 0 for the attractor at its end."""
    return _bound(rows, V, t, rows.high, rows.low, 1.0)


def least(rows: IntervalRows, V: Floats, t: Floats) -> Floats:
    """Return lower bounds of p'V; see :func:`most`."""
    return np.maximum(_bound(rows, V, t, rows.low, rows.high, -1.0), 0.0)


def _bound(
    rows: IntervalRows, V: Floats, t: Floats, above: Floats, below: Floats, direction: float
) -> Floats:
    owner, start = rows.owner, rows.pointer[:-1]
    away = V[rows.target] - t[owner]
    terms = np.where(away > 0, above, below) * away
    size = np.abs(t) + np.add.reduceat(np.abs(terms), start)
    slack = (np.diff(rows.pointer) + OPERATIONS) * (UNIT * size + LEAST)
    found: Floats = t + np.add.reduceat(terms, start) + direction * 2 * slack
    return found


def is_above(rows: IntervalRows, G: Floats, factor: float, V: Floats, t: Floats) -> Bools:
    """Decide V >= G + factor p'V for all rows p, cell by cell; V >= 0 has shape (n,)."""
    if not (np.isfinite(V).all() and (V >= 0).all() and np.isfinite(t).all()):
        return np.zeros(len(V), dtype=np.bool_)
    right = G + factor * most(rows, np.append(V, 0.0), t)
    return np.asarray(V - right * (1 + OPERATIONS * UNIT) >= 0)


def is_below(rows: IntervalRows, G: Floats, factor: float, V: Floats, t: Floats) -> Bools:
    """Decide V <= G + factor p'V for all rows p, cell by cell; V >= 0 has shape (n,)."""
    if not (np.isfinite(V).all() and (V >= 0).all() and np.isfinite(t).all()):
        return np.zeros(len(V), dtype=np.bool_)
    right = G + factor * least(rows, np.append(V, 0.0), t)
    return np.asarray(right * (1 - OPERATIONS * UNIT) >= V)
