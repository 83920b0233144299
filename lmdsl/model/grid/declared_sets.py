"""The cells of a declared set, a union of blocks of cells and of conditions: of all, or of some.

What must hold: on any cells a set says what it says of them among all, to the bit.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Guard, Indices
from lmdsl.machine.forking import cached_property
from lmdsl.model.grid.conditions import OnAxes
from lmdsl.model.grid.partition import Partition

CellBlock = tuple[Indices | range, ...]  # on each axis the cells of a block


class _Blocks(NamedTuple):
    """Blocks that hold a cell, and the first and the last cell of each, in C order."""

    each: list[CellBlock]
    first: Indices
    last: Indices


@dataclass(frozen=True, eq=False)
class DeclaredSet:
    """Which cells belong to a set.

    Attributes
    ----------
    partition
        The cells.
    blocks
        Returns the blocks, which may be many, one at a time.
    conditions
        Where conditions hold.
    guard
        Called now and then; it may raise.
    """

    partition: Partition
    blocks: Callable[[], Iterable[CellBlock]]
    conditions: tuple[OnAxes, ...]
    guard: Guard

    def everywhere(self) -> Bools:
        """Return which cells of the box belong to it, shape (N,)."""
        mask = self.partition.mask(self.blocks(), self.guard)
        for condition in self.conditions:
            mask |= condition.everywhere(self.partition)
        return mask

    @property
    def empty(self) -> bool:
        """Whether no cell belongs to it."""
        return not (len(self._blocks.each) or any(each.held.any() for each in self.conditions))

    def on(self, cells: Indices, index: tuple[Indices, ...]) -> Bools:
        """Return which of some cells belong to it: ascending ones, with their index by axis."""
        found = np.zeros(len(cells), dtype=np.bool_)
        for condition in self.conditions:
            found |= condition.on(index, self.partition)
        blocks = self._blocks
        begin, end = np.searchsorted(cells, blocks.first), np.searchsorted(cells, blocks.last + 1)
        for k in np.flatnonzero(begin < end):
            self.guard()
            some = slice(int(begin[k]), int(end[k]))
            inside = np.ones(some.stop - some.start, dtype=np.bool_)
            for at, span, count in zip(index, blocks.each[k], self.partition.shape, strict=True):
                if isinstance(span, range):
                    if len(span) < count:
                        inside &= (at[some] >= span.start) & (at[some] < span.stop)
                else:
                    inside &= np.isin(at[some], span)
            found[some] |= inside
        return found

    @cached_property
    def _blocks(self) -> _Blocks:
        each, ends = [], []
        for block in self.blocks():
            self.guard()
            if all(len(span) for span in block):
                each.append(block)
                ends.append([[int(min(span)), int(max(span))] for span in block])
        hull = np.array(ends, dtype=np.int64).reshape(-1, self.partition.dimension, 2)
        first, last = (
            np.ravel_multi_index(tuple(hull[:, :, side].T), self.partition.shape) for side in (0, 1)
        )
        return _Blocks(each, first, last)
