"""Which columns of a model surely end in a set of cells, whatever the state in the cell."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lmdsl.common.types import Bools
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import fixed
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.counting import keep, table
from lmdsl.model.successors.ranges import Ranges, enclosed


@dataclass(frozen=True, eq=False)
class Staying:
    """The cells that every column of a model can meet."""

    lp: StabilizationLP
    ranges: Ranges

    @classmethod
    def of(cls, lp: StabilizationLP, deadline: Deadline) -> Self:
        """Enclose the images of all columns.

        TimeLimitReached: there was no time.
        """
        attractor = lp.cell_status == CellStatus.ATTRACTOR
        avoid = lp.cell_status == CellStatus.AVOID
        sets = CellSets.made(attractor, avoid, np.ones(lp.partition.size))
        pairs = (lp.cells[lp.cell], lp.control)
        return cls(lp, enclosed(lp.problem, lp.partition, sets, pairs, deadline))

    def within(self, allowed: Bools, columns: Bools | None = None) -> Bools:
        """Return which columns surely end in a set of cells, shape (K,); of some only if given."""
        found = ~self.ranges.out
        if columns is not None:
            found &= columns
        at = np.flatnonzero(found)
        kept = np.ones(len(at), dtype=np.bool_)
        first, last = self.ranges.first[at], self.ranges.last[at]
        keep(table(~allowed, self.lp.partition), fixed(first), fixed(last), kept)
        found[at] = kept
        return found

    def surely(self) -> Bools:
        """Return which columns surely end on a lower sure level, shape (K,)."""
        lp, level = self.lp, self.lp.sure_levels
        found = np.zeros(lp.K, dtype=np.bool_)
        if level is None:
            return found
        own = level[lp.cells[lp.cell]]
        for L in range(1, int(level.max(initial=0)) + 1):
            found |= self.within((level >= 0) & (level < L), own == L)
        return found
