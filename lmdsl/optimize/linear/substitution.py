"""The part of a system without cycles: solved by substitution, whatever the rest costs.

A policy leads most cells to the attractor without ever passing through the same cell again. Cells
that no other cell leads to are taken away, then those that only these lead to, and so on, level by
level (Kahn's algorithm). No cell leads to another of its level, so a large level is solved in
several threads; its cells ascend, which keeps memory close. What is left, the core, holds every
cycle (staying put is no cycle here) and all that cycles lead to; nothing in it depends on the cells
taken away. So x = b + M x is solved on the core, then the others follow in the reverse order, each
from cells already known. The transposed system, which mu satisfies, goes the other way: mass
flows down to the core, which is solved last.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices
from lmdsl.machine import threads
from lmdsl.machine.forking import cached_property
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.optimize.linear.gauss_seidel import CEILING, NEVER, SplitMatrix

CellNumbers = NDArray[np.uint32]

# Number of cells of a level from which on it is solved in threads, and number of its ranges.
PARALLEL_FROM, PARTS = 40_000, 8

WORD, BYTE = np.uint64(64), np.uint64(8)

# Number of words that a level spans, for each of its cells, above which it is not sorted.
FAR = np.uint64(8)


@dataclass(frozen=True, eq=False)
class Peeled:
    """A system and its core."""

    system: SplitMatrix  # the whole
    order: CellNumbers  # cells outside the core, each before all it leads to
    levels: Indices  # where each level of ``order`` ends
    core: CellNumbers  # the other cells, ascending
    inner: SplitMatrix  # the system on the core, its cells numbered as in ``core``

    @classmethod
    def of(cls, system: SplitMatrix) -> Self:
        """Find the core of a system."""
        n = len(system.begin)
        order = np.empty(n + int(BYTE), dtype=np.uint32)
        ends = np.empty(n + 1, dtype=np.int64)
        ways, free = np.zeros(n, dtype=np.uint32), np.zeros(n // int(WORD) + 1, dtype=np.uint64)
        count, levels = _peel(system.begin, system.end, system.indices, order, ends, ways, free)
        order, ends = order[:n], ends[:levels].copy()
        if not count:
            return cls(system, order[:0], ends, order, system)
        core = order[count:]
        number = np.empty(n, dtype=np.uint32)
        number[core] = np.arange(len(core), dtype=np.uint32)
        begin = np.zeros(len(core), dtype=np.uint64)
        length = system.end[core] - system.begin[core]
        np.cumsum(length[:-1], out=begin[1:])
        entries = int(length.sum())
        indices, data = np.empty(entries, dtype=np.uint32), np.empty(entries)
        _take(core, system.begin, system.end, system.indices, system.data, number, indices, data)
        inner = SplitMatrix(
            begin, begin + length, indices, data, system.inverse[core],
            system.directions.among(core),
        )  # fmt: skip
        return cls(system, order[:count], ends, core, inner)

    @property
    def small(self) -> bool:
        """Whether the core is at most half of the cells: worth being solved first."""
        return 2 * len(self.core) <= len(self.system.begin)

    def substitute(self, b: Floats, x: Floats) -> bool:
        """Solve x = b + M x outside the core in place; False where there is no finite solution."""
        system = self.system.kernel

        def part(span: tuple[int, int]) -> bool:
            cells = self.order[span[0] : span[1]]
            return bool(_back(cells, system, b, x))

        for first, last, large in reversed(self._spans):
            if large:
                ends = threads.ranges(last - first, PARTS)
                found = all(threads.each(part, [(first + i, first + k) for i, k in ends]))
            else:
                found = part((first, last))
            if not found:
                return False
        return True

    @cached_property
    def _spans(self) -> list[tuple[int, int, bool]]:
        """Large levels, and what lies between them, as ranges of ``order``."""
        starts = np.concatenate([[0], self.levels[:-1]]).astype(np.int64)
        spans, at = [], 0
        for k in np.flatnonzero(self.levels - starts[: len(self.levels)] >= PARALLEL_FROM):
            first, last = int(starts[k]), int(self.levels[k])
            if first > at:
                spans.append((at, first, False))
            spans.append((first, last, True))
            at = last
        if at < len(self.order):
            spans.append((at, len(self.order), False))
        return spans

    def flow(self, x: Floats) -> bool:
        """Solve x = b + M'x outside the core in place, for x = b on entry.

        On the core x becomes b and what flows in from outside. False where there is no finite
        solution.
        """
        return bool(_down(self.order, self.system.kernel, x))


@kernel
def _peel(begin, end, indices, order, ends, ways, free):  # type: ignore[no-untyped-def]
    """Order the cells outside the core, then those in it; return how many are outside, and levels.

    ``ways`` counts the entries that lead to a cell, ``free`` has a bit for each cell of the next
    level; both are zeros on entry. No branch depends on data: every cell is written and only those
    that count are kept.
    """
    n = np.uint64(len(begin))
    for i in range(n):
        for e in range(begin[i], end[i]):
            ways[indices[e]] += np.uint32(1)
    count, at, levels = np.uint64(0), np.uint64(0), 0
    for i in range(n):
        order[count] = i
        count += np.uint64(ways[i] == 0)
    while at < count:
        ends[levels] = last = count
        levels += 1
        low, high = np.uint64(len(free)), np.uint64(0)
        for t in range(at, last):
            i = order[t]
            for e in range(begin[i], end[i]):
                j = np.uint64(indices[e])
                left = ways[j] - np.uint32(1)
                ways[j] = left
                word = j // WORD
                free[word] |= np.uint64(left == 0) << (j % WORD)
                low = word if word < low else low
                high = word if word > high else high
                order[count] = j
                count += np.uint64(left == 0)
        if low <= high and high - low > FAR * (count - last):  # few, far apart: as they came
            for t in range(last, count):
                free[order[t] // WORD] = np.uint64(0)
            low, high = np.uint64(1), np.uint64(0)
        else:
            count = last
        for w in range(low, high + ONE):
            bits, first = free[w], np.uint64(w) * WORD
            free[w] = np.uint64(0)
            while bits != np.uint64(0):
                for d in range(BYTE):
                    order[count] = first + d
                    count += (bits >> d) & ONE
                bits, first = bits >> BYTE, first + BYTE
        at = last
    outside = count
    for i in range(n):
        order[count] = i
        count += np.uint64(ways[i] > 0)
    return outside, levels


@kernel
def _take(core, begin, end, indices, data, number, out_indices, out_data):  # type: ignore[no-untyped-def]
    used = np.uint64(0)
    for r in range(np.uint64(len(core))):
        for e in range(begin[core[r]], end[core[r]]):
            out_indices[used] = number[indices[e]]
            out_data[used] = data[e]
            used += ONE


@kernel
def _back(order, system, b, x):  # type: ignore[no-untyped-def]
    begin, end, indices, data, inverse = system
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


@kernel
def _down(order, system, x):  # type: ignore[no-untyped-def]
    begin, end, indices, data, inverse = system
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
