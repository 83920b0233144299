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
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl import bellman
from lmdsl.lp import StabilizationLP
from lmdsl.rows import Slots, copy_row
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

    Attributes
    ----------
    slots, paid
        The rows of the policy after the last pass, copied while they are at hand, and its stage
        costs, shape (n,).
    """

    def __init__(
        self, lp: StabilizationLP, gamma: float | None = None, cost: Floats | None = None
    ) -> None:
        self.lp = lp
        self.gamma = lp.gamma if gamma is None else gamma
        self.cost = lp.cost if cost is None else cost
        self.least = np.zeros(lp.K, dtype=np.float32)
        self.rival = np.zeros(lp.n, dtype=np.float32)
        self.paid = np.empty(lp.n)
        self.scale = 1.0
        self.passes = 0

    @cached_property
    def slots(self) -> Slots:
        """Room for the rows of the policy."""
        return Slots.of(self.lp.rows, self.lp.pair_pointer, self.gamma)

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
        own, slots = pair.view(np.uint64), self.slots.kernel

        def part(cells: tuple[int, int]) -> tuple[int, int]:
            changed, looked = _pass(
                *cells, lp.kernel[0], self.cost, x, own, margin, self.scale, backwards,
                self.least, self.rival, value, new.view(np.uint64), self.paid, *slots,
            )  # fmt: skip
            return int(changed), int(looked)

        counts = bellman.over_cells(lp, part, bellman.IN_PLACE)
        return Pass(value, new, sum(c for c, _ in counts), sum(k for _, k in counts))

    def tied(
        self, V: Floats, tolerance: float, pair: Pairs
    ) -> tuple[NDArray[np.bool_], Pairs, bool]:
        """Find the columns with Q <= Q_min + tolerance |Q_min| at V, and those of a policy.

        Parameters
        ----------
        V, tolerance
            An optimal value, shape (n,), to a relative 1e-9, and what counts as equal, below 1e-7.
        pair
            A policy with this value, a column per cell.

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
        self.scale *= float(_least_ratio(before, after)) * (1 - 1e-13)
        if self.scale < LEAST_SCALE:
            self.least *= np.float32(self.scale)
            self.rival *= np.float32(self.scale)
            self.scale = 1.0


@njit(cache=True, nogil=True)
def _least_ratio(before, after):  # type: ignore[no-untyped-def]
    """The smallest after / before where ``before`` is positive, at most 1."""
    ratio = 1.0
    for i in range(len(before)):
        if after[i] < ratio * before[i]:
            ratio = after[i] / before[i]
    return ratio


@njit(cache=True, nogil=True)
def _pass(  # type: ignore[no-untyped-def]
    first, last, pair_pointer, cost, V, pair, margin, scale, backwards, least, rival, value, new,
    paid, held, pointer, target, code, share, columns, gamma, begins, ends, indices, data, inverse,
):  # fmt: skip
    """Improve the cells of a range in turn; ``least`` gets the bounds of the rows that were read.

    V_i >= Q of the cell's own pair, so a pair whose bound exceeds V_i is no better; the own row is
    read only where some rival remains. ``rival`` is the smallest bound of a cell's rivals.
    """
    changed, looked = 0, np.uint64(0)
    first, last = np.uint64(first), np.uint64(last)
    x = V.copy()  # other ranges keep the values from before the pass
    store, shrink = (1.0 - 1e-6) / scale, 1.0 / scale
    candidate = np.empty(_most(first, last, pair_pointer), dtype=np.uint64)
    for t in range(last - first):
        i = last - ONE - t if backwards else first + t
        own, limit = pair[i], x[i] * shrink
        new[i] = own
        if rival[i] < limit:
            # First a list without a branch, then a loop without one: a processor that guesses wrong
            # which rows are read waits for memory.
            begin, end = pair_pointer[i], pair_pointer[i + ONE]
            count, rest = np.uint64(0), MOST
            for d in range(end - begin):
                k = end - ONE - d if backwards else begin + d
                near = (least[k] < limit) | (k == own)
                candidate[count] = k
                count += np.uint64(near)
                bound = MOST if near else least[k]
                rest = bound if bound < rest else rest
            own_q, best, second, choice = np.inf, np.inf, np.inf, own
            for c in range(count):
                k = candidate[c]
                q = 0.0
                for e in range(pointer[k], pointer[k + ONE]):
                    q += share[code[e]] * x[target[e]]
                q = gamma * q + cost[k]
                least[k] = q * store if q * store < MOST else MOST
                own_q = q if k == own else own_q
                larger = q if q > best else best
                second = larger if larger < second else second
                if q < best:
                    best, choice = q, k
            looked += count
            if choice != own:
                if best < own_q - margin * abs(own_q):
                    changed += 1
                    new[i] = choice
                else:
                    second, best = best, own_q
            if best < x[i]:
                x[i] = best
            rival[i] = second * store if second * store < rest else rest
        if held[i] != new[i]:  # its row is at hand now
            held[i] = new[i]
            paid[i] = cost[new[i]]
            copy_row(
                i, new[i], pointer, target, code, share, columns, gamma,
                begins, ends, indices, data, inverse,
            )  # fmt: skip
    for i in range(first, last):
        value[i] = x[i]
    return changed, looked


@njit(cache=True, nogil=True)
def _most(first, last, pair_pointer):  # type: ignore[no-untyped-def]
    """Return the largest number of pairs of a cell."""
    most = np.uint64(0)
    for i in range(first, last):
        most = max(most, pair_pointer[i + ONE] - pair_pointer[i])
    return most


@njit(cache=True, nogil=True)
def _ties(  # type: ignore[no-untyped-def]
    first, last, pair_pointer, pointer, target, code, share, cost, gamma, V, tolerance, scale,
    least, pair, ties, chosen,
):  # fmt: skip
    """Mark the tied columns of a range of cells: first Q_min, then all that come near.

    Where the bounds leave only a cell's own pair, no row is read.
    """
    several = False
    first, last = np.uint64(first), np.uint64(last)
    most = _most(first, last, pair_pointer)
    q, candidate = np.empty(most), np.empty(most, dtype=np.uint64)
    for i in range(first, last):
        own, limit = pair[i], V[i] * (1.0 + tolerance + 1e-9) / scale
        count = np.uint64(0)
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            ties[k] = False
            candidate[count] = k
            count += np.uint64((least[k] <= limit) | (k == own))
        if count == ONE:
            ties[own], chosen[i] = True, own
            continue
        best = np.inf
        for c in range(count):
            k, q_k = candidate[c], 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q_k += share[code[e]] * V[target[e]]
            q[c] = gamma * q_k + cost[k]
            best = min(best, q[c])
        tied, chosen[i] = 0, -1
        for c in range(count):
            k = candidate[c]
            if q[c] <= best + tolerance * abs(best) or k == own:
                ties[k] = True
                tied += 1
                if chosen[i] < 0:
                    chosen[i] = k
        several |= tied > 1
    return several
