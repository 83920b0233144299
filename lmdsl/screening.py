"""Improvement passes that leave out what earlier passes prove worse.

Along a falling sequence of values V the Q of a pair falls too, but no faster than V does: if
V' >= r V then gamma P_a V' + G_a >= r (gamma P_a V + G_a) for 0 < r <= 1, because G_a >= 0. So
Q / scale, stored once, with the product of all ratios so far, bounds Q from below for ever; a pair
whose bound exceeds what the cell has already needs no look at its row. Bounds are single precision,
a millionth below what was computed: far more than all rounding. Late passes read one number a
cell, no rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl import bellman
from lmdsl.lp import StabilizationLP
from lmdsl.sweeps import ONE

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]

LEAST_SCALE = 1e-30
MOST = np.float32(3e38)


@dataclass(frozen=True)
class Pass:
    """The outcome of one pass.

    Attributes
    ----------
    value
        min(V, T V) where a control changed, min(V, T_u V) elsewhere, shape (n,).
    pair
        The policy after the pass, shape (n,).
    changed
        Number of cells whose control changed.
    looked
        Number of rows read.
    """

    value: Floats
    pair: Pairs
    changed: int
    looked: int


class Screen:
    """Lower bounds of every Q, kept along a falling sequence of values.

    Parameters
    ----------
    lp
        The model.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    """

    def __init__(
        self, lp: StabilizationLP, gamma: float | None = None, cost: Floats | None = None
    ) -> None:
        self.lp = lp
        self.gamma = lp.gamma if gamma is None else gamma
        self.cost = lp.cost if cost is None else cost
        self.least = np.zeros(lp.K, dtype=np.float32)
        self.rival = np.zeros(lp.n, dtype=np.float32)
        self.scale = 1.0
        self.passes = 0

    def improve(self, V: Floats, pair: Pairs, margin: float) -> Pass:
        """Change a control where another one is better by more than a relative margin.

        Cells are visited forwards and backwards by turns, each with the new values of those before
        it in the same range of cells, so that news travels far in a pass.

        Parameters
        ----------
        V, pair
            Values, shape (n,), and the policy, a column per cell.
        margin
            Q < Q_u - margin |Q_u| counts as better.
        """
        lp = self.lp
        value, new = np.empty(lp.n), np.empty(lp.n, dtype=np.int64)
        x, backwards = bellman.padded(V), self.passes % 2 == 1
        self.passes += 1
        own = pair.view(np.uint64)

        def part(cells: tuple[int, int]) -> tuple[int, int]:
            changed, looked = _pass(
                *cells, *lp.kernel,
                self.cost, self.gamma, x, own, margin, self.scale,
                backwards, self.least, self.rival, value, new,
            )  # fmt: skip
            return int(changed), int(looked)

        counts = bellman.over_cells(lp, part, bellman.IN_PLACE)
        return Pass(value, new, sum(c for c, _ in counts), sum(k for _, k in counts))

    def tied(
        self, V: Floats, tolerance: float, pair: Pairs
    ) -> tuple[NDArray[np.bool_], Pairs, bool]:
        """Find the columns with Q <= Q_min + tolerance |Q_min| at V, and those of a policy.

        Returns
        -------
        ties : shape (K,)
        first : shape (n,), the first tied column of every cell
        several : whether a cell has more than one
        """
        lp = self.lp
        x, ties = bellman.padded(V), np.empty(lp.K, dtype=np.bool_)
        first, own = np.empty(lp.n, dtype=np.int64), pair.view(np.uint64)

        def part(cells: tuple[int, int]) -> bool:
            several = _ties(
                *cells, *lp.kernel,
                self.cost, self.gamma, x, tolerance, self.scale, self.least, own,
                ties, first,
            )  # fmt: skip
            return bool(several)

        return ties, first, any(bellman.over_cells(lp, part))

    def follow(self, before: Floats, after: Floats) -> None:
        """Note that V fell from ``before`` to ``after``."""
        on = before > 0
        ratio = float(np.divide(after, before, out=np.ones(len(before)), where=on).min(initial=1.0))
        self.scale *= ratio * (1 - 1e-13)
        if self.scale < LEAST_SCALE:
            self.least *= np.float32(self.scale)
            self.rival *= np.float32(self.scale)
            self.scale = 1.0


@njit(cache=True, nogil=True)
def _pass(  # type: ignore[no-untyped-def]
    first, last, pair_pointer, pointer, target, code, share, cost, gamma, V, pair, margin, scale,
    backwards, least, rival, value, new,
):  # fmt: skip
    """Improve the cells of a range in turn; ``least`` gets the bounds of the rows that were read.

    V_i >= Q of the cell's own pair, so a pair whose bound exceeds V_i is no better; the own Q is
    computed only where some rival remains. ``rival`` is the smallest bound of a cell's rivals.
    """
    changed, looked = 0, 0
    first, last = np.uint64(first), np.uint64(last)
    x = V.copy()  # other ranges keep the values from before the pass
    store, shrink = (1.0 - 1e-6) / scale, 1.0 / scale
    for t in range(last - first):
        i = last - ONE - t if backwards else first + t
        own = pair[i]
        new[i] = own
        limit = x[i] * shrink
        if rival[i] >= limit:
            continue
        own_q, best, choice = np.inf, np.inf, own
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            if least[k] >= limit or k == own:
                continue
            if own_q == np.inf:
                own_q = 0.0
                for e in range(pointer[own], pointer[own + ONE]):
                    own_q += share[code[e]] * x[target[e]]
                own_q = gamma * own_q + cost[own]
                looked += 1
                least[own] = own_q * store if own_q * store < MOST else MOST
                best = own_q
                if own_q * shrink < limit:
                    limit = own_q * shrink
                if least[k] >= limit:
                    continue
            q = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q += share[code[e]] * x[target[e]]
            q = gamma * q + cost[k]
            looked += 1
            least[k] = q * store if q * store < MOST else MOST
            if q < best:
                best, choice, limit = q, k, q * shrink
        if choice != own and best < own_q - margin * abs(own_q):
            changed += 1
            new[i] = choice
        else:
            best = own_q
        if best < x[i]:
            x[i] = best
        smallest = MOST
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            if k != new[i] and least[k] < smallest:
                smallest = least[k]
        rival[i] = smallest
    for i in range(first, last):
        value[i] = x[i]
    return changed, looked


@njit(cache=True, nogil=True)
def _ties(  # type: ignore[no-untyped-def]
    first, last, pair_pointer, pointer, target, code, share, cost, gamma, V, tolerance, scale,
    least, pair, ties, chosen,
):  # fmt: skip
    """Mark the tied columns of a range of cells: first Q_min, then all that come near."""
    several = False
    choices = np.uint64(0)
    first, last = np.uint64(first), np.uint64(last)
    for i in range(first, last):
        choices = max(choices, pair_pointer[i + ONE] - pair_pointer[i])
    q = np.empty(choices)
    for i in range(first, last):
        begin, end = pair_pointer[i], pair_pointer[i + ONE]
        best = np.inf
        for k in range(begin, end):
            if least[k] * scale > best * (1.0 + tolerance):
                q[k - begin] = np.inf
                continue
            q_k = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q_k += share[code[e]] * V[target[e]]
            q_k = gamma * q_k + cost[k]
            q[k - begin] = q_k
            best = min(best, q_k)
        count, chosen[i] = 0, -1
        for k in range(begin, end):
            ties[k] = q[k - begin] <= best + tolerance * abs(best) or k == pair[i]
            if ties[k]:
                count += 1
                if chosen[i] < 0:
                    chosen[i] = k
        several |= count > 1
    return several
