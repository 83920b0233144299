"""How many cells of a set lie in index ranges: by sums over all cells before (a summed table).

A table has one more entry an axis than there are cells, twice as many cells on circles, so that a
range across the seam is one product. The number of cells in a range is a sum over its 2^d corners.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Guard
from lmdsl.machine import memory
from lmdsl.machine.kernels import fixed, kernel
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.windows import Window


class Table(NamedTuple):
    """Sums of a set of cells.

    Attributes
    ----------
    sums
        Flat, of the table described in the module.
    corner
        Offset of each of the 2^d corners of a range from the first, by axis 0 or 1: shape (2^d, d).
    sign
        +1 or -1 by corner, shape (2^d,).
    stride
        Distance in ``sums`` of neighbours on each axis, shape (d,).
    """

    sums: NDArray[np.int64]
    corner: NDArray[np.int64]
    sign: NDArray[np.int64]
    stride: NDArray[np.int64]


def table(cells: Bools, where: Partition | Window, guard: Guard | None = None) -> Table:
    """Return the table of a set of cells, a mask of the cells of a box or a window.

    It can be far larger than that. Ranges are those of the box, or have entered the window.
    """
    window = where if isinstance(where, Window) else Window.whole(where)
    marked, turns = cells.reshape(window.shape), [2 if on else 1 for on in window.circles]
    d, lengths = marked.ndim, [n * k for n, k in zip(marked.shape, turns, strict=True)]
    memory.require(16 * float(np.prod([n + 1.0 for n in lengths])), "sums over the cells")
    marked = np.tile(marked, turns)
    sums = np.zeros([n + 1 for n in lengths], dtype=np.int64)
    sums[(slice(1, None),) * d] = marked
    for k in range(d):
        if guard:
            guard()
        np.cumsum(sums, axis=k, out=sums)
    corner = (np.arange(2**d)[:, None] >> np.arange(d)) & 1
    sign = np.where((d - corner.sum(axis=1)) % 2, -1, 1).astype(np.int64)
    stride = np.array(sums.strides) // sums.itemsize
    return Table(*(fixed(x) for x in (sums.ravel(), corner, sign, stride)))


GOING, ABSORBED, LOST = 0, 1, 2  # what became of a step so far


@kernel
def count(table, first, last, k, part):  # type: ignore[no-untyped-def]
    """Return how many cells of the set a range holds."""
    sums, corner, sign, stride = table
    total = 0
    for c in range(len(sign)):
        at = 0
        for a in range(len(stride)):
            end = last[k, part, a] + 1 if corner[c, a] else np.int64(first[k, part, a])
            at += end * stride[a]
        total += sign[c] * sums[at]
    return total


@kernel
def meets(table, first, last, k):  # type: ignore[no-untyped-def]
    """Return whether a range of pair k, of any part of the noise, holds a cell of the set."""
    found = False
    for part in range(first.shape[1]):
        found = found or count(table, first, last, k, part) > 0
    return found


@kernel
def keep(table, first, last, kept):  # type: ignore[no-untyped-def]
    """Unmark the pairs of which a range holds a cell of the set."""
    for k in range(len(kept)):
        kept[k] = kept[k] and not meets(table, first, last, k)


@kernel
def judge(judged, first, last, out, way, state):  # type: ignore[no-untyped-def]
    """Let ranges decide what becomes of steps, on the way or at its end, shape (pairs, parts).

    Where a step was absorbed before, its range becomes the cell for that.
    """
    avoid, attractor, absorbed = judged
    for k in range(len(first)):
        for part in range(first.shape[1]):
            if state[k, part] == GOING:
                if out[k, part] or count(avoid, first, last, k, part) > 0:
                    state[k, part] = LOST
                elif way[k, part]:
                    cells = np.int64(1)
                    for a in range(first.shape[2]):
                        cells *= np.int64(last[k, part, a]) - np.int64(first[k, part, a]) + 1
                    if count(attractor, first, last, k, part) == cells:
                        state[k, part] = ABSORBED
            if state[k, part] == ABSORBED:
                for a in range(first.shape[2]):
                    first[k, part, a] = last[k, part, a] = absorbed[a]


@kernel
def join(first, last, circle, least, most):  # type: ignore[no-untyped-def]
    """Fill in the hulls of pieces, of shape (ranges, pieces, others), NaN where one is.

    On a circle of so many cells a piece is turned next to those before; 0: it is none.
    """
    for r in range(len(first)):
        for i in range(first.shape[2]):
            a, b = first[r, 0, i], last[r, 0, i]
            for p in range(1, first.shape[1]):
                x, y = first[r, p, i], last[r, p, i]
                if circle > 0.0:
                    turn = np.rint((a + b - x - y) / (2.0 * circle)) * circle
                    x, y = x + turn, y + turn
                a = a if (a < x) | (a != a) else x
                b = b if (b > y) | (b != b) else y
            least[r, i], most[r, i] = a, b


@kernel
def hulls(pairs, first, last, least, most):  # type: ignore[no-untyped-def]
    """Fill in the hulls of all ranges of every cell, shape (cells, 1, d)."""
    for i in range(len(least)):
        for a in range(least.shape[2]):
            for k in range(pairs[i], pairs[i + 1]):
                for part in range(first.shape[1]):
                    if (k == pairs[i] and part == 0) or first[k, part, a] < least[i, 0, a]:
                        least[i, 0, a] = first[k, part, a]
                    most[i, 0, a] = max(most[i, 0, a], last[k, part, a])


@kernel
def drop(table, reach, pairs, ranges, alive, choices):  # type: ignore[no-untyped-def]
    """Drop the pairs that can meet the set, and count them off.

    ``reach`` are the hulls of cells, ``ranges`` the ranges of pairs: first and last each.
    """
    for i in range(len(choices)):
        if choices[i] > 0 and meets(table, reach[0], reach[1], i):
            for k in range(pairs[i], pairs[i + 1]):
                if alive[k] and meets(table, ranges[0], ranges[1], k):
                    alive[k] = False
                    choices[i] -= 1


@kernel
def lift(front, others, reach, pairs, ranges, alive, level, chosen):  # type: ignore[no-untyped-def]
    """Choose the cells without level of which a pair meets none of the others.

    ``front`` is the table of the cells of the last level, ``others`` that of those without level,
    and of avoid: who cannot meet the first was looked at before.
    """
    for i in range(len(level)):
        if level[i] < 0 and meets(front, reach[0], reach[1], i):
            for k in range(pairs[i], pairs[i + 1]):
                if alive[k] and not meets(others, ranges[0], ranges[1], k):
                    chosen[i] = True
                    break
