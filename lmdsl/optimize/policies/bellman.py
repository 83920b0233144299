"""Passes over all pairs: the Bellman operator (T V)_i = min_a gamma (P_a V)_i + G_a.

One compiled loop per idea. Vectors over C carry one more entry, 0, for the attractor.
"""

from dataclasses import dataclass

import numpy as np

from lmdsl.certificate.vectors import over_cells, padded
from lmdsl.common.types import Bools, Floats, Policy
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.lp import StabilizationLP

IN_PLACE = 4  # number of ranges of a pass in which a cell sees the new values of its own range only


@dataclass(frozen=True, eq=False)
class Improvement:
    """The result of one pass."""

    value: Floats  # (T V)_i, shape (n,)
    policy: Policy  # the first minimising column of every cell, shape (n,)


def improve(
    lp: StabilizationLP, V: Floats, gamma: float | None = None, cost: Floats | None = None
) -> Improvement:
    """Apply the Bellman operator to V, shape (n,), with its gamma and cost, (K,), or others."""
    value, policy = np.empty(lp.n), np.empty(lp.n, dtype=np.int64)
    gamma = lp.gamma if gamma is None else gamma
    cost = lp.cost if cost is None else cost
    over_cells(lp, _improve, *lp._kernel, cost, gamma, padded(lp, V), value, policy)
    return Improvement(value, policy)


def rise(lp: StabilizationLP, V: Floats, gamma: float, backwards: bool) -> Improvement:
    """Make a pass of value iteration under unit cost, cell by cell, staying put summed up at once.

    From V <= T V the pass raises V, and it stays below the least unit cost. The cells of a range
    are visited ``backwards`` or forwards.
    """
    value, policy = np.empty(lp.n), np.empty(lp.n, dtype=np.int64)
    x = padded(lp, V)

    def part(first: int, last: int) -> None:
        own = x.copy()  # the others keep the values from before
        _rise(first, last, *lp._kernel, gamma, own, backwards, value, policy)

    over_cells(lp, part, most=IN_PLACE)
    return Improvement(value, policy)


def below(lp: StabilizationLP, V: Floats, limit: Floats) -> Bools:
    """Return the columns with Q <= limit at V, shape (K,); ``limit`` has shape (n,)."""
    found = np.empty(lp.K, dtype=np.bool_)
    over_cells(lp, _below, *lp._kernel, lp.cost, lp.gamma, padded(lp, V), limit, found)
    return found


def tied(lp: StabilizationLP, V: Floats, best: Floats, tolerance: float) -> Bools:
    """Return the columns with Q <= Q_min + tolerance |Q_min|, shape (K,)."""
    return below(lp, V, best + tolerance * np.abs(best))


@kernel
def _improve(first, last, pair_pointer, rows, cost, gamma, V, value, policy):  # type: ignore[no-untyped-def]
    pointer, target, code, share = rows
    for i in range(np.uint64(first), np.uint64(last)):
        best, choice = np.inf, pair_pointer[i]
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            q = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q += share[code[e]] * V[target[e]]
            q = gamma * q + cost[k]
            if q < best:
                best, choice = q, k
        value[i], policy[i] = best, choice


@kernel
def _below(first, last, pair_pointer, rows, cost, gamma, V, limit, found):  # type: ignore[no-untyped-def]
    pointer, target, code, share = rows
    for i in range(np.uint64(first), np.uint64(last)):
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            q = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q += share[code[e]] * V[target[e]]
            found[k] = gamma * q + cost[k] <= limit[i]


@kernel
def _rise(first, last, pair_pointer, rows, gamma, x, backwards, value, policy):  # type: ignore[no-untyped-def]
    pointer, target, code, share = rows
    first, last = np.uint64(first), np.uint64(last)
    for t in range(last - first):
        i = last - ONE - t if backwards else first + t
        best, choice = np.inf, pair_pointer[i]
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            own, q = 0.0, 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q += share[code[e]] * x[target[e]]
                own += share[code[e]] if target[e] == i else 0.0
            q, left = 1.0 + gamma * (q - own * x[i]), 1.0 - gamma * own
            if left > 0.0 and q < best * left:
                best, choice = q / left, k
        x[i] = best if best > x[i] else x[i]
        policy[i] = choice
    for i in range(first, last):
        value[i] = x[i]
