"""The cells that hold, over ranks: all ranks find them alike, and keep no more than they know.

What must hold: they, and their controls, are those of :func:`lmdsl.model.local.holding.held`.
Every rank assembles the pairs of the attractor's cells; of all others it meets what these lead to.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lmdsl.common.types import Bools, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.sets import CellSets
from lmdsl.problem import Problem
from lmdsl.problem.local_control import HoldControl
from lmdsl.ranks.verbs import Ranks
from lmdsl.slabs.graph.pieces import PieceSets


@dataclass(frozen=True, eq=False)
class HeldCells:
    """The cells that hold, ascending, and the index of the control of each."""

    cells: Indices
    control: holding.Controls

    @classmethod
    def of(
        cls, ranks: Ranks, problem: Problem, partition: Partition, sets: CellSets,
        deadline: Deadline,
    ) -> Self | None:  # fmt: skip
        """Return the cells that hold, of the declared sets; None: none is asked to. Collective."""
        if not isinstance(problem.local_controller, HoldControl):
            return None
        if not isinstance(sets, PieceSets):
            index = ranks.agreed(lambda: holding.held(problem, partition, sets, deadline))
            assert index is not None
            cells = np.flatnonzero(index >= 0)
            return cls(cells, index[cells])
        kinds, mass = sets.pieces.kinds, sets.mass

        def inner(cells: Indices) -> tuple[Bools, Bools]:
            return kinds(cells)[1], np.zeros(len(cells), dtype=np.bool_)

        def way(cells: Indices) -> tuple[Bools, Bools]:
            free, attractor = kinds(cells)
            return free | attractor, np.zeros(len(cells), dtype=np.bool_)

        within, along = (PieceSets.of_kinds(ranks, partition, k, mass) for k in (inner, way))
        return ranks.agreed(
            lambda: cls(*holding.kept(problem, partition, within, along, deadline, part=True))
        )

    def on(self, first: int, last: int) -> holding.Controls:
        """Return the controls of the cells first..last-1 of the box, -1 where none holds."""
        index = np.full(last - first, -1, dtype=np.int32)
        some = slice(*np.searchsorted(self.cells, (first, last)).tolist())
        index[self.cells[some] - first] = self.control[some]
        return index

    def within(
        self, ranks: Ranks, problem: Problem, partition: Partition, sets: CellSets
    ) -> CellSets:
        """Return the sets that are compiled: see :func:`holding.within`; collective."""
        local = problem.local_controller
        if not isinstance(local, HoldControl) or local.partial:
            return sets
        if not isinstance(sets, PieceSets):
            return holding.within(sets, problem, self.on(0, partition.size))
        kinds = sets.pieces.kinds

        def compiled(cells: Indices) -> tuple[Bools, Bools]:
            free, attractor = kinds(cells)
            near = slice(*np.searchsorted(self.cells, (cells[0], cells[-1] + 1)).tolist())
            held = np.isin(cells, self.cells[near], assume_unique=True)
            return free | (attractor & ~held), held

        return PieceSets.of_kinds(ranks, partition, compiled, sets.mass)
