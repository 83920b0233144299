"""Along which axis slabs need the fewest cells of others, as some cells tell.

Ranks own slabs of cells, cut along one axis. A *ghost* of a rank is a cell of another one that its
own cells lead to. The box is divided into blocks of cells, about as many along every axis, and the
middle cell of each is looked at: every cell that it leads to moves the whole block by as much. Of
the blocks of a slab, moved so, the cells in other slabs are counted, each once: what blocks cover
together is the difficulty, and is found along the axis exactly, across it by whole blocks. Cells
count that lie in blocks whose middle is in C. Where every cell is a block of its own, this is the
number of ghosts itself, of slabs that are whole planes.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.model.grid.partition import Partition

MOST_SLABS = 16  # beyond, slabs are thinner than blocks, and what these cover is far too much
CLEARLY, WORTH = 2 / 3, 0.05  # the part of ghosts, and how many fewer, for which axes are reordered
LARGE = 10**5  # number of cells from which the order of axes is worth a word


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of cells that fill the box; numbered in C order."""

    partition: Partition
    edges: tuple[Indices, ...]  # of every axis: the first plane of each block, then their number

    @classmethod
    def of(cls, partition: Partition, most: int) -> "Blocks":
        """Return at most so many blocks, about as many along every axis as it has cells."""
        shape, counts, left = partition.shape, [1] * partition.dimension, float(most)
        for done, k in enumerate(sorted(range(len(shape)), key=shape.__getitem__)):
            share = int(left ** (1 / (len(shape) - done)) + 1e-9)
            counts[k] = max(1, min(shape[k], share))
            left /= counts[k]
        edges = [np.arange(b + 1) * n // b for b, n in zip(counts, shape, strict=True)]
        return cls(partition, tuple(edges))

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of blocks along every axis."""
        return tuple(len(ends) - 1 for ends in self.edges)

    @property
    def middles(self) -> Indices:
        """The cell that is looked at in each block, ascending."""
        every = [(ends[:-1] + ends[1:]) // 2 for ends in self.edges]
        cells = np.ravel_multi_index(np.ix_(*every), self.partition.shape)
        return np.asarray(cells, dtype=np.int64).ravel()

    def volume(self, inside: Indices) -> Floats:
        """Return the number of cells of some blocks, 0 for the others, shape of the blocks."""
        found = np.zeros(self.shape)
        found.ravel()[inside] = 1.0
        for k, ends in enumerate(self.edges):
            found *= np.diff(ends).reshape([-1 if j == k else 1 for j in range(len(self.shape))])
        return found

    def at(self, k: int, plane: Indices) -> Indices:
        """Return the block of every plane of an axis."""
        found: Indices = np.searchsorted(self.edges[k], plane, side="right") - 1
        return found


class Looked(NamedTuple):
    """What is known of middles in C.

    Attributes
    ----------
    block, pairs
        Their blocks, ascending, and how many pairs each has.
    source, target
        Which of them leads to which cell of the box, in C.
    """

    block: Indices
    pairs: Indices
    source: Indices
    target: Indices


def ghosts(blocks: Blocks, looked: Looked, count: int) -> dict[str, float]:
    """Return how many ghosts ``count`` slabs have for each cell of C, were they cut along an axis.

    By name of the axes that have a plane for each slab.
    """
    partition, volume = blocks.partition, blocks.volume(looked.block)
    if not len(looked.block):
        return {}
    found = {}
    for k, planes in enumerate(partition.shape):
        if planes >= max(count, 2):
            along = _Along(blocks, looked, volume, k)
            cuts = along.cuts(looked.pairs, count).tolist()
            known = math.fsum(along.ghosts(a, b) for a, b in pairwise(cuts))
            found[partition.names[k]] = known / float(volume.sum())
    return found


class _Along:
    """The blocks, and where they are moved to, along an axis; the others make its columns."""

    def __init__(self, blocks: Blocks, looked: Looked, volume: Floats, k: int) -> None:
        p = blocks.partition
        self.planes, self.edges, self.periodic = p.shape[k], blocks.edges[k], bool(p.periodic[k])
        self.block = np.unravel_index(looked.block, blocks.shape)[k]
        self.weight = volume.ravel()[looked.block]
        cell = p.multi_index(blocks.middles[looked.block])[k]
        target = p.multi_index(looked.target)
        across = [j for j in range(p.dimension) if j != k]
        shape = [blocks.shape[j] for j in across]
        at = [blocks.at(j, target[j]) for j in across]
        self.column = np.ravel_multi_index(at, shape) if at else np.zeros_like(looked.target)
        self.moved = target[k] - cell[looked.source]
        self.first = self.edges[self.block][looked.source]
        self.last = self.edges[self.block + 1][looked.source]
        cells = np.moveaxis(volume, k, -1).reshape(-1, len(self.edges) - 1)
        self.plane = np.append(cells / np.diff(self.edges), np.zeros((len(cells), 1)), axis=1)
        self.before = np.append(np.zeros((len(cells), 1)), np.cumsum(cells, axis=1), axis=1)

    def cuts(self, pairs: Indices, count: int) -> Indices:
        """Return the first plane of slabs of about as many pairs each, then their number."""
        each = np.bincount(self.block, self.weight * pairs, minlength=len(self.edges) - 1)
        sums = np.append(0.0, np.cumsum(each))
        cuts = np.interp(np.arange(count + 1) * (sums[-1] / count), sums, self.edges)
        cuts[0], cuts[-1] = 0, self.planes
        found: Indices = np.rint(cuts).astype(np.int64)
        return found

    def ghosts(self, a: int, b: int) -> float:
        """Return how many cells outside of the planes a to b - 1 blocks inside are moved to."""
        first, last = np.maximum(self.first, a), np.minimum(self.last, b)
        own = np.flatnonzero(last > first)
        column, by = self.column[own], self.moved[own]
        column, first, last = self._in_box(column, first[own] + by, last[own] + by)
        column = np.concatenate([column, column])
        first, last = (
            np.concatenate([first, np.maximum(first, b)]),
            np.concatenate([np.minimum(last, a), last]),
        )
        out = last > first
        return self._covered(column[out], first[out], last[out])

    def _in_box(
        self, column: Indices, first: Indices, last: Indices
    ) -> tuple[Indices, Indices, Indices]:
        """Return the parts of planes in the box, those round a circle from its other end on."""
        n = self.planes
        if not self.periodic:
            return column, np.clip(first, 0, n), np.clip(last, 0, n)
        turns = first // n * n
        first, last = first - turns, last - turns
        over = last > n
        return (
            np.concatenate([column, column[over]]),
            np.concatenate([first, np.zeros(int(over.sum()), dtype=np.int64)]),
            np.concatenate([np.minimum(last, n), last[over] - n]),
        )

    def _covered(self, column: Indices, first: Indices, last: Indices) -> float:
        """Return how many cells of C lie in these planes of columns, each counted once."""
        begin = column * (self.planes + 1)
        order = np.argsort(begin + first)
        column, first, last, begin = (x[order] for x in (column, first, last, begin))
        reached = np.maximum.accumulate(begin + last)
        first = np.maximum(first, np.append(0, reached[:-1]) - begin)
        new = last > first
        column, first, last = column[new], first[new], last[new]
        return math.fsum(self._below(column, last) - self._below(column, first))

    def _below(self, column: Indices, plane: Indices) -> Floats:
        """Return how many cells of C a column has below a plane."""
        at = np.searchsorted(self.edges, plane, side="right") - 1
        found: Floats = self.before[column, at]
        return found + self.plane[column, at] * (plane - self.edges[at])


def better(
    partition: Partition, counted: dict[str, float], clearly: float = CLEARLY
) -> tuple[str, float, float] | None:
    """Return the axis to declare first, its ghosts, and those of the one that is; None: no matter.

    Cells are cut along the first axis that has more than one.
    """
    first = next((x for x, n in zip(partition.names, partition.shape, strict=True) if n > 1), "")
    if first not in counted:
        return None
    best = min(counted, key=counted.__getitem__)
    few, now = counted[best], counted[first]
    return (best, few, now) if few < clearly * now and now - few > WORTH else None


def sentence(partition: Partition, counted: dict[str, float] | None, count: int) -> str:
    """Return which axis to declare first, where so many ranks then have clearly fewer ghosts.

    Empty where they have not, and of a small problem.
    """
    found = better(partition, counted or {}) if partition.size >= LARGE else None
    if found is None:
        return ""
    name, few, now = found
    return (
        f"declare {name} first in state_box: {min(count, MOST_SLABS)} ranks would know about "
        f"{few:.2g} cells of others for each own one instead of {now:.2g}"
    )
