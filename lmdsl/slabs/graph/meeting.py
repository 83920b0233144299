"""What the images of whole cells can meet, over ranks: pairs that survive, and sure arrival.

Each rank encloses the images of its own pairs. They can meet cells of any rank, so what becomes of
cells is told to all, a bit for each free cell of the box: every rank then looks at the same set.
The set that is left is the greatest one, whatever the order; a level is the least number of steps.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools
from lmdsl.machine.kernels import fixed
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.counting import Table, drop, lift, table
from lmdsl.model.successors.survival import Successors
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import Item, RankError, Ranks

STAMP = 8  # bytes at the end of each message: which one of the series it is


@dataclass(eq=False)
class Marks:
    """Marks on free cells that all ranks see, told by the owner of every cell.

    Attributes
    ----------
    ranks, division
        Who talks, and which free cells are whose.
    told
        How often marks were told.
    """

    ranks: Ranks
    division: Division
    told: int = 0

    def everywhere(self, own: Bools) -> Bools:
        """Return the marks of all cells, shape (cells,), of those of own ones; collective.

        Every rank knows how many bits are due from each other one: a rank that has other cells
        than all have agreed on, or sends marks of another time, is refused.
        """
        ranks, division = self.ranks, self.division
        self.told += 1
        stamp = np.array([self.told], dtype=np.uint64).view(np.uint8)
        mine = np.concatenate([np.packbits(own), stamp])
        starts = division.starts
        sizes = {k: (int(n) + 7) // 8 + STAMP for k, n in enumerate(np.diff(starts))}
        if len(own) != starts[ranks.rank + 1] - starts[ranks.rank]:
            raise RankError(f"rank {ranks.rank} marks {len(own)} cells, which are not its own")
        came = ranks.exchange(dict.fromkeys(range(ranks.count), mine), sizes, np.uint8)
        found = np.empty(division.cells, dtype=np.bool_)
        for k, bits in came.items():
            if not np.array_equal(bits[-STAMP:], stamp):
                raise RankError(f"rank {k} sent rank {ranks.rank} marks of another time")
            count = int(starts[k + 1] - starts[k])
            found[starts[k] : starts[k + 1]] = np.unpackbits(bits[:-STAMP], count=count)
        return found


@dataclass(frozen=True, eq=False)
class OwnSuccessors:
    """The cells that every own pair can meet; see :class:`Successors`. All is collective.

    Attributes
    ----------
    sets
        The cells of the box by what they are.
    marks
        How ranks tell each other what becomes of their free cells.
    own
        What the own pairs can meet.
    """

    sets: CellSets
    marks: Marks
    own: Successors

    def remove(self, lost: Bools, alive: Bools, inside: Bools) -> None:
        """Remove own cells, the pairs that can meet what any rank lost, and cells without a pair.

        All arguments are of own cells or pairs.
        """
        own, pointer = self.own, fixed(self.own.transitions.pair_pointer)
        alive &= ~lost[owner(pointer)]
        choices = own.choices(alive)
        while True:
            inside &= ~lost
            every = self.marks.everywhere(lost)
            if not every.any():
                return
            removed = self._agreed(lambda seen=every: self._table(self._spread(seen)))  # type: ignore[misc]
            drop(removed, own._reach, pointer, own._ranges, alive, choices)
            lost = inside & (choices == 0)

    def sure_levels(self, first: int, last: int) -> NDArray[np.int32]:
        """Return in how many steps some controller surely enters A, of the cells of the box.

        These are first..last-1, among which the own free ones are; 0 on A, -1: unknown.
        """
        own, sets = self.own, self.sets
        level = np.full(len(own.transitions.pair_pointer) - 1, -1, dtype=np.int32)
        front, below = sets.attractor, 0
        while front.any():  # the same on all ranks
            others = self._spread(self.marks.everywhere(level < 0)) | sets.avoid
            tables = self._agreed(
                lambda a=front, b=others: (self._table(a), self._table(b))  # type: ignore[misc]
            )
            chosen = np.zeros(len(level), dtype=np.bool_)
            lift(*tables, own._reach, fixed(own.transitions.pair_pointer), own._ranges,
                 fixed(own.admissible), fixed(level), chosen)  # fmt: skip
            below += 1
            level[chosen] = below
            front = self._spread(self.marks.everywhere(chosen))
        sure = np.full(last - first, -1, dtype=np.int32)
        sure[sets.attractor[first:last]] = 0
        a, b = self.marks.division.own(self.marks.ranks.rank)
        sure[sets.free[a:b] - first] = level
        return sure

    def _agreed(self, work: Callable[[], Item]) -> Item:
        return self.marks.ranks.agreed(work)

    def _table(self, cells: Bools) -> Table:
        return table(cells, self.own.partition, self.own._guard)

    def _spread(self, marked: Bools) -> Bools:
        """Return marked free cells as cells of the box, shape (N,)."""
        cells = np.zeros(len(self.sets.number), dtype=np.bool_)
        cells[self.sets.free] = marked
        return cells
