"""What the images of whole cells can meet, over ranks: pairs that survive, and sure arrival.

Each rank encloses the images of its own pairs, and knows the cells of a window that these can meet,
which are of any rank. What becomes of cells their owners tell all ranks that have them in their
windows, a bit for each free cell. The set that is left is the greatest one, whatever the order; a
level is the least number of steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools
from lmdsl.machine.forking import cached_property
from lmdsl.machine.kernels import fixed
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.counting import drop, lift
from lmdsl.model.successors.survival import Successors
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import Item, Ranks
from lmdsl.slabs.graph.telling import Telling


@dataclass(frozen=True, eq=False)
class OwnSuccessors:
    """The cells that every own pair can meet; see :class:`Successors`. All is collective.

    Attributes
    ----------
    sets
        The cells of the box by what they are.
    marks
        How ranks tell each other what becomes of the free cells in their windows.
    own
        What the own pairs can meet.
    """

    sets: CellSets
    marks: Telling
    own: Successors

    @classmethod
    def of(cls, ranks: Ranks, division: Division, sets: CellSets, own: Successors) -> Self:
        """Agree of which free cells a rank hears: those in the window of its own pairs."""
        runs = [(sets.free_before(a), sets.free_before(b)) for a, b in own.window.runs]
        return cls(sets, Telling.agreed(ranks, division.starts, runs), own)

    def remove(self, lost: Bools, alive: Bools, inside: Bools) -> None:
        """Remove own cells, the pairs that can meet what any rank lost, and cells without a pair.

        All arguments are of own cells or pairs.
        """
        own, pointer = self.own, fixed(self.own.transitions.pair_pointer)
        alive &= ~lost[owner(pointer)]
        choices = own.choices(alive)
        while self.marks.ranks.any(bool(lost.any())):
            inside &= ~lost
            seen = self._spread(lost)
            removed = self._agreed(lambda marked=seen: own.table(marked))  # type: ignore[misc]
            drop(removed, own._reach, pointer, own._ranges, alive, choices)
            lost = inside & (choices == 0)

    def sure_levels(self, first: int, last: int) -> NDArray[np.int32]:
        """Return in how many steps some controller surely enters A, of the cells of the box.

        These are first..last-1, among which the own free ones are; 0 on A, -1: unknown.
        """
        own, sets = self.own, self.sets
        level = np.full(len(own.transitions.pair_pointer) - 1, -1, dtype=np.int32)
        front, below = own.window.of(sets.attractor), 0
        others = ~front  # those without level, and avoid
        while self.marks.ranks.any(bool(front.any())):
            tables = self._agreed(
                lambda a=front, b=others: (own.table(a), own.table(b))  # type: ignore[misc]
            )
            chosen = np.zeros(len(level), dtype=np.bool_)
            lift(*tables, own._reach, fixed(own.transitions.pair_pointer), own._ranges,
                 fixed(own.admissible), fixed(level), chosen)  # fmt: skip
            below += 1
            level[chosen] = below
            front = self._spread(chosen)
            others &= ~front
        sure = np.full(last - first, -1, dtype=np.int32)
        sure[sets.attractor[first:last]] = 0
        starts, rank = self.marks.starts, self.marks.ranks.rank
        sure[sets.free[starts[rank] : starts[rank + 1]] - first] = level
        return sure

    def _agreed(self, work: Callable[[], Item]) -> Item:
        return self.marks.ranks.agreed(work)

    def _spread(self, marked: Bools) -> Bools:
        """Return marked own cells, and those of others, as cells of the window; collective."""
        cells = np.zeros(self.own.window.size, dtype=np.bool_)
        cells[self._free] = self.marks.heard(marked)
        return cells

    @cached_property
    def _free(self) -> Bools:
        """Which cells of the window are free."""
        window, sets = self.own.window, self.sets
        return ~(window.of(sets.attractor) | window.of(sets.avoid))
