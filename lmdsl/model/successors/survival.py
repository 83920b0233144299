"""What enclosures leave of a model: the pairs that survive, and where arrival is sure.

A pair is admissible if its range lies in the box outside avoid; it survives while all cells of its
range lie in C u A. So a run of the map that starts in a cell of C, under a controller that uses
surviving pairs, never leaves the box, never enters avoid and always finds a control until it enters
A (docs/mathematics.md). Sampled rows lie within the ranges.

Whole cells are looked at first: most cells cannot meet what has changed.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices, Progress
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import fixed
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.windows import Window, met
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.assumed import require_samples_within
from lmdsl.model.successors.counting import Table, drop, hulls, keep, lift, table
from lmdsl.model.successors.ranges import enclosed
from lmdsl.problem.problem import Problem

DOING = "enclosing images"


@dataclass(frozen=True, eq=False)
class Successors:
    """The cells that every pair of a problem can meet.

    Attributes
    ----------
    admissible
        Which pairs stay in the box and outside avoid, on the whole cell, shape (pairs,).
    window
        What ranges of admissible pairs lie in, and are numbered by.
    """

    transitions: Transitions
    window: Window
    admissible: Bools
    _ranges: tuple[NDArray[Any], NDArray[Any]]  # of pairs
    _reach: tuple[NDArray[Any], NDArray[Any]]  # of all pairs of a cell
    _deadline: Deadline

    @classmethod
    def asked_for(
        cls,
        problem: Problem,
        partition: Partition,
        transitions: Transitions,
        deadline: Deadline,
        progress: Progress | None = None,
        way: CellSets | None = None,
        cells: Indices | None = None,
        windowed: bool = False,
    ) -> Self | None:
        """Enclose the images of all pairs of some transitions; None where samples suffice.

        ``way`` are the sets that judge the way of steps, where these are others than judge its end;
        ``cells`` those whose pairs they are, where they are not those of all free cells. Then the
        sets are read in the least window that holds their ranges, if it is ``windowed``.
        """
        if problem.successors != "enclosed":
            return None
        pointer, sets = transitions.pair_pointer, transitions.sets
        cells = sets.free if cells is None else cells
        pairs = cells[owner(pointer)], transitions.control
        found = enclosed(problem, partition, way or sets, pairs, deadline, progress, windowed)
        first, last, admissible = found.first, found.last, ~found.out
        if "system" in problem.functions:
            require_samples_within(transitions, partition, (first, last), admissible, cells)
        window = Window.whole(partition)
        if windowed:
            window = Window.around(partition, met(first, last, admissible))
            window.enter(first, last)
        memory.require(2.0 * first.itemsize * len(cells) * partition.dimension, DOING)
        shape = (len(cells), 1, partition.dimension)
        least, most = (np.zeros(shape, dtype=first.dtype) for _ in range(2))
        hulls(fixed(pointer), fixed(first), fixed(last), least, most)
        ranges, reach = (fixed(first), fixed(last)), (fixed(least), fixed(most))
        if way is not None:
            keep(table(window.of(sets.avoid), window), *ranges, admissible)
        return cls(transitions, window, admissible, ranges, reach, deadline)

    def choices(self, alive: Bools) -> Indices:
        """Return how many pairs of every cell are alive, shape (F,)."""
        pointer = self.transitions.pair_pointer
        return np.bincount(owner(pointer)[alive], minlength=len(pointer) - 1).astype(np.int64)

    def remove(self, lost: Bools, alive: Bools, inside: Bools) -> None:
        """Remove free cells, the pairs that can meet them, and cells left without a pair."""
        pointer = self.transitions.pair_pointer
        alive &= ~lost[owner(pointer)]
        choices = self.choices(alive)
        while lost.any():
            self._guard()
            inside &= ~lost
            removed = self.table(self._spread(lost))
            drop(removed, self._reach, fixed(pointer), self._ranges, alive, choices)
            lost = inside & (choices == 0)

    def sure_levels(self) -> NDArray[np.int32]:
        """Return in how many steps some controller surely enters A, shape (N,): 0 on A, else -1.

        A cell is on level L + 1 if a pair of it has its range in A and the cells of levels up to L.
        """
        sets = self.transitions.sets
        level = np.full(len(sets.free), -1, dtype=np.int32)
        front, below = sets.attractor, 0
        while front.any():
            self._guard()
            chosen = np.zeros(len(level), dtype=np.bool_)
            lift(
                self.table(front),
                self.table(self._spread(level < 0) | sets.avoid),
                self._reach, fixed(self.transitions.pair_pointer), self._ranges,
                fixed(self.admissible), fixed(level), chosen,
            )  # fmt: skip
            below += 1
            level[chosen] = below
            front = self._spread(chosen)
        sure = np.full(self.window.size, -1, dtype=np.int32)
        sure[sets.attractor] = 0
        sure[sets.free] = level
        return sure

    def table(self, cells: Bools) -> Table:
        """Return the table of marks on the cells of the window."""
        return table(cells, self.window, self._guard)

    def _guard(self) -> None:
        self._deadline.raise_if_over(DOING)

    def _spread(self, marked: Bools) -> Bools:
        """Return marked free cells as cells of the window; outside it no range meets them."""
        cells = np.zeros(self.window.size, dtype=np.bool_)
        at = self.window.positions(self.transitions.sets.free[marked.nonzero()[0]])
        cells[at[at >= 0]] = True
        return cells
