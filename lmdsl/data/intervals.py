"""How sure recorded probabilities are: simultaneous intervals, and the mass that was not seen.

The possible outcomes of a step are fixed before any data: each of the F cells outside A and Z, A,
and out (Z included), so F + 2 of them for each of the F M pairs. Every probability gets its exact
(Clopper-Pearson) interval at the level that makes all hold together by Bonferroni's inequality,
whatever is observed. A pair's row may then be any in its intervals that sums to 1 on the observed
successors: that no others exist is the assumption `support`, which no data removes.

How much it may hide is said beside it. If the n draws of a pair all fell in k outcomes, then with
the same simultaneous confidence the others have a mass of at most eps,
C(F + 2, k) (1 - eps)^n = (1 - level) / (F M (F + 2)):
a union over all sets of k outcomes, all k and all pairs.
"""

from dataclasses import dataclass

import numpy as np

from lmdsl.certificate.interval_checks import IntervalRows
from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Indices
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.systems import DataSystem

ROUNDING = 1e-9
"""Relative error allowed of SciPy's incomplete beta functions; intervals are wider by it."""


@dataclass(frozen=True, eq=False)
class Observed(Frozen):
    """What was recorded of some pairs of C: successors with their counts."""

    pointer: Indices  # shape (K + 1,): the successors of pair k are ``pointer[k]:pointer[k + 1]``
    target: Indices  # a position in ``lp.cells``, n for the attractor, each once in a row
    count: Indices
    columns: int  # n

    @property
    def total(self) -> Indices:
        """How often each pair was recorded, shape (K,)."""
        return np.add.reduceat(self.count, self.pointer[:-1]) if len(self.count) else self.count

    @property
    def owner(self) -> Indices:
        """The pair of every successor, shape (E,)."""
        return np.repeat(np.arange(len(self.pointer) - 1), np.diff(self.pointer))


@dataclass(frozen=True)
class Family:
    """The statements that hold together: one for each pair and possible outcome of it."""

    pairs: int  # F M
    outcomes: int  # F + 2

    @classmethod
    def of(cls, lp: StabilizationLP) -> "Family":
        """Count them; nothing in the data plays a part."""
        given = np.isin(lp.cell_status, (CellStatus.ATTRACTOR, CellStatus.AVOID))
        free = int((~given).sum())
        return cls(free * len(lp.controls), free + 2)


def observed(lp: StabilizationLP, columns: Indices) -> Observed:
    """Return what was recorded of some columns of the LP."""
    system = lp.problem.system
    assert isinstance(system, DataSystem)
    rows, M = system.rows, len(lp.controls)
    key = lp.cells[lp.cell[columns]] * M + lp.control[columns]
    row = np.searchsorted(rows.cell.astype(np.int64) * M + rows.control, key)
    length = np.diff(rows.pointer)[row]
    owner = np.repeat(np.arange(len(columns)), length)
    shift = np.repeat(rows.pointer[row] - np.concatenate([[0], np.cumsum(length)[:-1]]), length)
    entry = np.arange(len(owner)) + shift
    position = np.full(lp.partition.size, lp.n, dtype=np.int64)  # else the attractor: all survive
    position[lp.cells] = np.arange(lp.n)
    target, count = position[rows.target[entry]], system.counted()[entry]
    order = np.lexsort((target, owner))
    owner, target, count = owner[order], target[order], count[order]
    first = np.flatnonzero((np.diff(owner, prepend=-1) != 0) | (np.diff(target, prepend=-1) != 0))
    return Observed(
        np.searchsorted(owner[first], np.arange(len(columns) + 1)).astype(np.int64),
        target[first],
        np.add.reduceat(count, first) if len(first) else count,
        lp.n,
    )


def intervals(seen: Observed, family: Family, level: float) -> IntervalRows:
    """Return the rows that the data allow, all intervals together at a level."""
    tail = (1.0 - level) / family.pairs / family.outcomes / 2.0
    total = seen.total[seen.owner]
    low = _least(seen.count, total, tail)
    high = np.minimum(1.0 - _least(total - seen.count, total, tail) + 2.0**-52, 1.0)
    return IntervalRows(seen.pointer, seen.target, low, high, seen.columns)


def _least(count: Indices, total: Indices, tail: float) -> Floats:
    """Return p with P(X >= count) <= tail for X binomial with p: the lower limit, rounded down.

    A limit whose tail cannot be confirmed is replaced by 0, which is always one.
    """
    from scipy.special import betainc, betaincinv

    with np.errstate(all="ignore"):
        p = betaincinv(np.maximum(count, 1), total - count + 1, tail) * (1 - ROUNDING)
        found = betainc(np.maximum(count, 1), total - count + 1, p)
    return np.where((count > 0) & (found <= tail), p, 0.0)


def unseen(seen: Observed, family: Family, level: float) -> Floats:
    """Return the upper limit of the mass of each pair on what was not observed, shape (K,)."""
    return unseen_of(np.diff(seen.pointer), seen.total, family, level)


def unseen_of(k: Indices, total: Indices, family: Family, level: float) -> Floats:
    """Return the same of pairs of which ``total`` draws fell in k outcomes."""
    from scipy.special import gammaln

    E = float(family.outcomes)
    sets = gammaln(E + 1) - gammaln(k + 1.0) - gammaln(E - k + 1.0)
    chance = np.log1p(-level) - np.log(family.pairs) - np.log(E)
    return np.where(k < E, -np.expm1((chance - sets) / total), 0.0)
