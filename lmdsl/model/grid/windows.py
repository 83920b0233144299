"""Windows of the box: the cells that some ranges can meet, as a run of planes.

A plane are the cells of one index on the first axis; planes follow each other in C order. On a
circle a window may lie across the seam: it is what is left of the largest gap that no range meets,
so that the ranges lie in it as on a line. Where there is no gap, it is the whole circle.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices
from lmdsl.model.grid.partition import Partition

PART = 2**18  # number of ranges that are looked at at a time


@dataclass(frozen=True, eq=False)
class Window:
    """A run of planes; the whole box, unless it is made ``around`` ranges.

    Attributes
    ----------
    partition
        The box.
    start, planes
        The first plane, and how many there are; on a circle they may go across the seam.
    """

    partition: Partition
    start: int
    planes: int

    @classmethod
    def whole(cls, partition: Partition) -> Self:
        """Return the window that is the box."""
        return cls(partition, 0, partition.shape[0])

    @classmethod
    def around(cls, partition: Partition, runs: Indices, slack: int = 0) -> Self:
        """Return the least window with runs of planes, see :func:`joined`, and so many beside.

        Of no run it is one plane. A circle is closed only where the runs leave no gap.
        """
        n, circle = partition.shape[0], bool(partition.periodic[0])
        start, planes = hull(runs, n, circle)
        if circle:
            slack = max(min(slack, (n - 1 - planes) // 2), 0)
            return cls(partition, (start - slack) % n, planes + 2 * slack)
        first, last = max(start - slack, 0), min(start + planes + slack, n)
        return cls(partition, first, last - first)

    @property
    def is_whole(self) -> bool:
        """Whether it is the box."""
        return self.planes == self.partition.shape[0]

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells on each axis."""
        return (self.planes, *self.partition.shape[1:])

    @property
    def circles(self) -> list[bool]:
        """Along which axes it is a circle."""
        first, *others = map(bool, self.partition.periodic)
        return [first and self.is_whole, *others]

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.planes * self._plane

    @property
    def runs(self) -> list[tuple[int, int]]:
        """Its cells in order: runs of cells of the box, each the first and the one after the last.

        There are two where it lies across the seam.
        """
        n, end = self.partition.shape[0], self.start + self.planes
        runs = [(self.start, min(end, n))] + ([(0, end - n)] if end > n else [])
        return [(a * self._plane, b * self._plane) for a, b in runs]

    def of(self, cells: Bools) -> Bools:
        """Return the marks of its cells, of those of all cells of the box."""
        parts = [cells[a:b] for a, b in self.runs]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def positions(self, cells: Indices) -> Indices:
        """Return where cells of the box are among its own, -1 where they are not."""
        if self.is_whole:
            return cells
        at = cells - self.start * self._plane
        at = np.where(at < 0, at + self.partition.size, at)
        found: Indices = np.where((cells >= 0) & (at < self.size), at, -1)
        return found

    def holds(self, first: NDArray[Any], last: NDArray[Any]) -> Bools:
        """Return which runs of planes lie in it, from first to last index of each."""
        n, start = self.partition.shape[0], first.astype(np.int64) - self.start
        if not self.partition.periodic[0]:
            return np.asarray((start >= 0) & (last < self.start + self.planes))
        if self.is_whole:
            return np.ones(first.shape, dtype=np.bool_)
        return np.asarray(start % n + last - first < self.planes)

    def enter(self, first: NDArray[Any], last: NDArray[Any]) -> None:
        """Number the planes of ranges, shape (pairs, parts, d), from its first one, in place.

        A range that it does not hold becomes any of its planes.
        """
        if self.is_whole:
            return
        for k in range(0, len(first), PART):
            low, high = first[k : k + PART, :, 0], last[k : k + PART, :, 0]
            more = high - low
            low -= self.start
            low %= self.partition.shape[0]
            np.minimum(low, self.planes - 1, out=low)
            np.minimum(low + more, self.planes - 1, out=high)

    @property
    def _plane(self) -> int:
        return self.partition.size // self.partition.shape[0]


def joined(first: NDArray[Any], last: NDArray[Any]) -> Indices:
    """Return what runs of planes cover together: runs apart, ascending, of shape (runs, 2)."""
    if not len(first):
        return np.empty((0, 2), dtype=np.int64)
    order = np.argsort(first, kind="stable")
    low, high = first[order], np.maximum.accumulate(last[order])
    cut = np.flatnonzero(low[1:].astype(np.int64) > high[:-1].astype(np.int64) + 1)
    ends = low[np.append(0, cut + 1)], high[np.append(cut, -1)]
    return np.stack(ends, axis=-1).astype(np.int64)


def hull(runs: Indices, count: int, circle: bool) -> tuple[int, int]:
    """Return start and length of the least run that holds others, of ``count`` planes."""
    if not len(runs):
        return 0, 1
    if not circle:
        least, most = int(runs[:, 0].min()), int(runs[:, 1].max())
        return least, most - least + 1
    beyond = runs[runs[:, 1] >= count, 1] - count  # what lies across the seam
    first = np.append(runs[:, 0], np.zeros_like(beyond))
    last = np.append(np.minimum(runs[:, 1], count - 1), beyond)
    found = joined(first, last)
    gaps = np.append(found[1:, 0], found[0, 0] + count) - found[:, 1] - 1
    at = int(np.argmax(gaps))
    if gaps[at] <= 0:
        return 0, count
    return int(found[(at + 1) % len(found), 0]), count - int(gaps[at])


def met(first: NDArray[Any], last: NDArray[Any], some: Bools) -> Indices:
    """Return the runs of planes that the ranges of some pairs meet, see :func:`joined`."""
    found = [np.empty((0, 2), dtype=np.int64)]
    for k in range(0, len(some), PART):
        part = slice(k, k + PART)
        ends = (end[part, :, 0][some[part]].ravel() for end in (first, last))
        found.append(joined(*ends))
    every = np.concatenate(found)
    return joined(every[:, 0], every[:, 1])
