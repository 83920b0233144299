"""Equal parts of cells, numbered in C order of the finer grid; and which of them a box has."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.partition import Partition


class Parts(NamedTuple):
    """Equal parts of cells: bisections, parts, and stride by axis, shape (d,); and their number."""

    split: Indices
    shape: Indices
    stride: Indices
    size: int

    @classmethod
    def of(cls, partition: Partition, split: Indices) -> "Parts":
        """Return the grid of parts."""
        shape = partition.cells.astype(np.int64) << split
        stride = np.append(np.cumprod(shape[:0:-1])[::-1], 1).astype(np.int64)
        return cls(split, shape, stride, int(np.prod(shape.astype(object))))

    def by_axis(self, part: Indices) -> Indices:
        """Return the index of parts by axis, shape (len(part), d)."""
        return np.asarray(part[:, None] // self.stride % self.shape)

    def cell(self, partition: Partition, part: Indices) -> Indices:
        """Return the cells of parts."""
        stride = np.array([axis.stride for axis in partition.axes]).astype(np.int64)
        return np.asarray(((self.by_axis(part) >> self.split) * stride).sum(axis=1))


DEEPEST = 20  # bisections of an axis


def fits(partition: Partition, split: NDArray[np.uint8], count: int) -> bool:
    """Return whether cells cut so often have so many parts."""
    small = bool((split <= DEEPEST).all())
    return small and Parts.of(partition, split.astype(np.int64)).size == count


@kernel
def whole(parts, split, place, index, b):  # type: ignore[no-untyped-def]
    """Return the first part that meets box ``b`` of the cell with these indices, and how many do.

    ``parts`` has their bisections and their stride by axis. See :func:`one`.
    """
    fine, stride = parts
    count, first = np.int64(1), np.int64(0)
    for k in range(len(fine)):
        s, p = np.int64(split[b, k]), np.int64(place[b, k])
        less = fine[k] - s
        at = p >> -less if less < 0 else p << less
        first += ((index[b, k] << fine[k]) + at) * stride[k]
        count *= np.int64(1) << max(less, 0)
    return first, count


@kernel
def one(parts, split, b, first, j):  # type: ignore[no-untyped-def]
    """Return part ``j`` of those that meet box ``b``."""
    fine, stride = parts
    rest, at = np.int64(j), first
    for k in range(len(fine) - 1, -1, -1):
        less = max(fine[k] - np.int64(split[b, k]), 0)
        at += (rest & ((np.int64(1) << less) - 1)) * stride[k]
        rest >>= less
    return at
