"""The part of a system without cycles: solved by substitution, whatever the rest costs.

A policy leads most cells to the attractor without ever passing through the same cell again. Cells
that no other cell leads to are taken away, then those that only these lead to, and so on (Kahn's
algorithm). What is left, the core, holds every cycle (staying put is no cycle here) and all that
cycles lead to; nothing in it depends on the cells taken away. So x = b + M x is solved on the core,
then the others follow in the reverse order, each from cells already known. The transposed system,
which a measure satisfies, goes the other way: mass flows down to the core, which is solved last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl.sweeps import CEILING, NEVER, ONE, System

Floats = NDArray[np.float64]
Cells = NDArray[np.uint32]


@dataclass(frozen=True)
class Peeled:
    """A system and its core.

    Attributes
    ----------
    system
        The whole.
    order
        Cells outside the core, each before all it leads to.
    core
        The other cells, ascending.
    inner
        The system on the core, its cells numbered as in ``core``.
    """

    system: System
    order: Cells
    core: Cells
    inner: System

    @classmethod
    def of(cls, system: System) -> Peeled:
        """Find the core of a system."""
        n = len(system.begin)
        order = np.empty(n, dtype=np.uint32)
        count = _peel(system.begin, system.end, system.indices, order)
        if not count:
            return cls(system, order[:0], order, system)
        core = order[count:]
        number = np.empty(n, dtype=np.uint32)
        number[core] = np.arange(len(core), dtype=np.uint32)
        begin = np.zeros(len(core), dtype=np.uint64)
        length = system.end[core] - system.begin[core]
        np.cumsum(length[:-1], out=begin[1:])
        entries = int(length.sum())
        indices, data = np.empty(entries, dtype=np.uint32), np.empty(entries)
        _take(core, system.begin, system.end, system.indices, system.data, number, indices, data)
        inner = System(begin, begin + length, indices, data, system.inverse[core])
        return cls(system, order[:count], core, inner)

    @property
    def small(self) -> bool:
        """Whether the core is at most half of the cells: worth being solved first."""
        return 2 * len(self.core) <= len(self.system.begin)

    def substitute(self, b: Floats, x: Floats) -> bool:
        """Solve x = b + M x outside the core in place; False where there is no finite solution."""
        s = self.system
        return bool(_back(self.order, s.begin, s.end, s.indices, s.data, s.inverse, b, x))

    def flow(self, x: Floats) -> bool:
        """Solve x = b + M'x outside the core in place, for x = b on entry.

        On the core x becomes b and what flows in from outside. False where there is no finite
        solution.
        """
        s = self.system
        return bool(_down(self.order, s.begin, s.end, s.indices, s.data, s.inverse, x))


@njit(cache=True, nogil=True)
def _peel(begin, end, indices, order):  # type: ignore[no-untyped-def]
    """Order the cells outside the core, then those in it; return how many are outside."""
    n = np.uint64(len(begin))
    ways = np.zeros(n, dtype=np.uint32)  # how many entries lead to a cell
    for i in range(n):
        for e in range(begin[i], end[i]):
            ways[indices[e]] += np.uint32(1)
    count = np.uint64(0)
    for i in range(n):
        if ways[i] == 0:
            order[count] = i
            count += ONE
    at = np.uint64(0)
    while at < count:
        i = order[at]
        at += ONE
        for e in range(begin[i], end[i]):
            j = indices[e]
            ways[j] -= np.uint32(1)
            if ways[j] == 0:
                order[count] = j
                count += ONE
    outside = count
    for i in range(n):
        if ways[i] > 0:
            order[count] = i
            count += ONE
    return outside


@njit(cache=True, nogil=True)
def _take(core, begin, end, indices, data, number, out_indices, out_data):  # type: ignore[no-untyped-def]
    used = np.uint64(0)
    for r in range(np.uint64(len(core))):
        for e in range(begin[core[r]], end[core[r]]):
            out_indices[used] = number[indices[e]]
            out_data[used] = data[e]
            used += ONE


@njit(cache=True, nogil=True)
def _back(order, begin, end, indices, data, inverse, b, x):  # type: ignore[no-untyped-def]
    last = np.uint64(len(order))
    for t in range(last):
        i = order[last - ONE - t]
        y = b[i]
        for e in range(begin[i], end[i]):
            y += data[e] * x[indices[e]]
        if y != 0.0:
            y *= inverse[i]
            if inverse[i] >= NEVER or not y < CEILING:
                return False
        x[i] = y
    return True


@njit(cache=True, nogil=True)
def _down(order, begin, end, indices, data, inverse, x):  # type: ignore[no-untyped-def]
    for t in range(np.uint64(len(order))):
        i = order[t]
        y = x[i]
        if y != 0.0:
            y *= inverse[i]
            if inverse[i] >= NEVER or not y < CEILING:
                return False
        x[i] = y
        for e in range(begin[i], end[i]):
            x[indices[e]] += data[e] * y
    return True
