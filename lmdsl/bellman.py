"""Passes over all pairs: the Bellman operator (T V)_i = min_a gamma (P_a V)_i + G_a.

One compiled loop per idea. Vectors over C carry one more entry, 0, for the attractor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl.lp import StabilizationLP

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]


@dataclass(frozen=True)
class Improvement:
    """The result of one pass.

    Attributes
    ----------
    value
        (T V)_i, shape (n,).
    pair
        The first minimising column of every cell, shape (n,).
    """

    value: Floats
    pair: Pairs


def padded(V: Floats) -> Floats:
    """Append the attractor's 0."""
    return np.append(np.asarray(V, dtype=np.float64), 0.0)


def improve(
    lp: StabilizationLP,
    V: Floats,
    gamma: float | None = None,
    cost: Floats | None = None,
) -> Improvement:
    """Apply the Bellman operator to V, shape (n,).

    Parameters
    ----------
    lp, V
        The model and a value vector on C.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    """
    value, pair = np.empty(lp.n), np.empty(lp.n, dtype=np.int64)
    rows = lp.rows
    _improve(
        lp.pair_pointer, rows.pointer, rows.target, rows.code, rows.shares.value,
        lp.cost if cost is None else cost, lp.gamma if gamma is None else gamma, padded(V),
        value, pair,
    )  # fmt: skip
    return Improvement(value, pair)


def tied(lp: StabilizationLP, V: Floats, best: Floats, tolerance: float) -> NDArray[np.bool_]:
    """Return the columns with Q <= Q_min + tolerance |Q_min|, shape (K,)."""
    ties = np.empty(lp.K, dtype=np.bool_)
    rows = lp.rows
    _tied(
        lp.pair_pointer, rows.pointer, rows.target, rows.code, rows.shares.value,
        lp.cost, lp.gamma, padded(V), best + tolerance * np.abs(best), ties,
    )  # fmt: skip
    return ties


@njit(cache=True, nogil=True)
def _improve(pair_pointer, pointer, target, code, share, cost, gamma, V, value, pair):  # type: ignore[no-untyped-def]
    for i in range(len(pair_pointer) - 1):
        best, choice = np.inf, -1
        for k in range(pair_pointer[i], pair_pointer[i + 1]):
            q = 0.0
            for e in range(pointer[k], pointer[k + 1]):
                q += share[code[e]] * V[target[e]]
            q = gamma * q + cost[k]
            if q < best or choice < 0:
                best, choice = q, k
        value[i], pair[i] = best, choice


@njit(cache=True, nogil=True)
def _tied(pair_pointer, pointer, target, code, share, cost, gamma, V, limit, ties):  # type: ignore[no-untyped-def]
    for i in range(len(pair_pointer) - 1):
        for k in range(pair_pointer[i], pair_pointer[i + 1]):
            q = 0.0
            for e in range(pointer[k], pointer[k + 1]):
                q += share[code[e]] * V[target[e]]
            ties[k] = gamma * q + cost[k] <= limit[i]
