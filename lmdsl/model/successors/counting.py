"""How many cells of a set lie in index ranges: by sums over all cells before (a summed table).

A table has one more entry an axis than there are cells, twice as many cells on circles, so that a
range across the seam is one product. The number of cells in a range is a sum over its 2^d corners.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices
from lmdsl.machine import memory
from lmdsl.machine.kernels import fixed, kernel
from lmdsl.model.grid.partition import Partition


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


def table(cells: Bools, partition: Partition) -> Table:
    """Return the table of a set of cells, a mask of shape (N,)."""
    d, marked = partition.dimension, cells.reshape(partition.shape)
    lengths = [n * (2 if p else 1) for n, p in zip(marked.shape, partition.periodic, strict=True)]
    memory.require(16 * float(np.prod([n + 1.0 for n in lengths])), "sums over the cells")
    marked = np.tile(marked, [2 if p else 1 for p in partition.periodic])
    sums = np.zeros([n + 1 for n in lengths], dtype=np.int64)
    sums[(slice(1, None),) * d] = marked
    for k in range(d):
        np.cumsum(sums, axis=k, out=sums)
    corner = (np.arange(2**d)[:, None] >> np.arange(d)) & 1
    sign = np.where((d - corner.sum(axis=1)) % 2, -1, 1)
    stride = np.array(sums.strides) // sums.itemsize
    return Table(*(fixed(x) for x in (sums.ravel(), corner, sign, stride)))


@kernel
def meets(table, first, last, k):  # type: ignore[no-untyped-def]
    """Return whether a range of pair k, of any part of the noise, holds a cell of the set."""
    sums, corner, sign, stride = table
    for part in range(first.shape[1]):
        total = 0
        for c in range(len(sign)):
            at = 0
            for a in range(len(stride)):
                end = last[k, part, a] + 1 if corner[c, a] else first[k, part, a]
                at += np.int64(end) * stride[a]
            total += sign[c] * sums[at]
        if total > 0:
            return True
    return False


@kernel
def hulls(pair_pointer, first, last, least, most):  # type: ignore[no-untyped-def]
    """Fill in the hull of all ranges of every cell, shape (cells, 1, d)."""
    for i in range(len(least)):
        for a in range(least.shape[2]):
            low, high = least[i, 0, a], most[i, 0, a]
            for k in range(pair_pointer[i], pair_pointer[i + 1]):
                for part in range(first.shape[1]):
                    low, high = min(low, first[k, part, a]), max(high, last[k, part, a])
            least[i, 0, a], most[i, 0, a] = low, high


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
def lift(front, others, reach, pairs, ranges, alive, level, pair):  # type: ignore[no-untyped-def]
    """Put cells without level on the next one if a pair of theirs meets none of the others.

    ``front`` is the table of the cells of the last level, ``others`` that of those without level:
    who cannot meet the first was looked at before.
    """
    lifted = 0
    for i in range(len(level)):
        if level[i] < 0 and meets(front, reach[0], reach[1], i):
            for k in range(pairs[i], pairs[i + 1]):
                if alive[k] and not meets(others, ranges[0], ranges[1], k):
                    pair[i] = k
                    lifted += 1
                    break
    return lifted
