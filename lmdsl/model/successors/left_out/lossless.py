"""What no controller can keep: the cells and pairs that lose a run, whatever is done afterwards.

Of every pair of a cell and a control the images of some states of the cell are made, as a run makes
them. K is the greatest set of cells in which every cell keeps a control under which all of these
lead to K or A. A controller that loses no run that starts in a cell that it controls, controls
cells of K only, each by a pair that survives (docs/mathematics.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices, Progress
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.assembly.transitions import Transitions, assemble
from lmdsl.model.discretization import node_count
from lmdsl.model.grid.partition import Partition
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import keeping, sets_of
from lmdsl.problem.problem import Problem
from lmdsl.problem.sampling import Grid

SAMPLES = 2**23  # most samples of all pairs, unless FEWEST an axis take more
FEWEST, MOST = 2, 33  # points an axis
LARGEST = 2**27  # samples above which it is not looked at all: minutes of work
INSET = 2.0**-20  # of a cell, by which points lie within it: they are states of it, not of others


class States(Grid):
    """States of a cell, evenly spaced on each axis from next to one face to next to the other."""

    def _points(self, states: Sequence[str]) -> Floats:
        axes = [INSET + (1.0 - 2.0 * INSET) * np.arange(k) / (k - 1) for k in self._each(states)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


@dataclass(frozen=True, eq=False)
class Lossless:
    """What a controller that loses no run may control, as far as some states of cells tell.

    Attributes
    ----------
    lp
        The model of all pairs.
    transitions
        The pairs under which no state leaves the box, and the cells that all states lead to.
    inside
        Which free cells may be controlled, shape (F,).
    alive
        Which pairs survive, shape (pairs,).
    """

    lp: StabilizationLP
    problem: Problem
    transitions: Transitions
    inside: Bools
    alive: Bools

    @classmethod
    def of(
        cls, lp: StabilizationLP, deadline: Deadline, progress: Progress | None = None
    ) -> Self | None:
        """Look at some states of all cells; None where that takes too long, or too much memory."""
        partition, sets = lp.partition, sets_of(lp.cell_status)
        if max(axis.margin for axis in partition.axes) > INSET / 4:
            return None  # too fine for doubles: it is not known in which cell such states lie
        pairs = len(sets.free) * len(lp.controls)
        if pairs * node_count(lp.problem) * FEWEST**partition.dimension > LARGEST:
            return None
        problem = _by_states(lp.problem, partition, pairs)
        try:
            found = assemble(problem, partition, progress, deadline, sets)
        except (BadInput, TimeLimitReached):
            return None
        inside, alive = keeping(found.pair_pointer, found.rows)
        return cls(lp, problem, found, inside, alive)

    @property
    def share(self) -> float:
        """Largest share of C that a controller can bring to A, or keep, without a run lost."""
        kept = np.zeros(self.lp.partition.size, dtype=np.bool_)
        kept[self.transitions.sets.free[self.inside]] = True
        return int(kept[self.lp.cells].sum()) / max(self.lp.n, 1)

    def losing(self) -> Indices:
        """Return the pairs (cell, control) of the model that do not survive, shape (D, 2)."""
        return self._others(self.alive)

    def _others(self, alive: Bools) -> Indices:
        """Return the pairs of the model but for those of the transitions that are alive."""
        lp, M = self.lp, len(self.lp.controls)
        cell = self.transitions.sets.free[owner(self.transitions.pair_pointer)[alive]]
        left = cell * M + self.transitions.control[alive]
        every = lp.cells[lp.cell] * M + lp.control
        found = every[~np.isin(every, left, assume_unique=True)]
        return np.stack(np.divmod(found, M), axis=-1)

    def losing_most(self) -> tuple[Indices, Bools]:
        """Return the pairs by which more is lost at once than by others of their cell, (D, 2).

        And the cells of which every pair loses something, shape (N,). Lost is what leaves C and A.
        """
        lp, free, rows = self.lp, self.transitions.sets.free, self.transitions.rows
        good = np.zeros(len(free) + 1, dtype=np.bool_)
        good[-1] = True
        good[np.searchsorted(free, lp.cells)] = True
        row = np.repeat(np.arange(rows.count), np.diff(rows.pointer))
        clean = np.ones(rows.count, dtype=np.bool_)
        clean[row[~good[rows.target]]] = False
        dropped = self._others(clean)
        hopeless = np.zeros(lp.partition.size, dtype=np.bool_)
        hopeless[lp.cells] = True
        hopeless[free[owner(self.transitions.pair_pointer)[clean]]] = False
        all_lose = hopeless[dropped[:, 0]]
        return np.concatenate([dropped[~all_lose], self._worse(dropped[all_lose])]), hopeless

    def losing_some(self, cells: Indices, control: Indices) -> Indices:
        """Return the pairs of a controller under which some of many states leave its cells or A.

        Shape (D, 2). There are more states than where all pairs are looked at.
        """
        sampled = _by_states(self.lp.problem, self.lp.partition, 2 * len(cells))
        pairs = np.stack([cells, control], axis=-1)
        return pairs[self._lost(pairs, cells, sampled) > 0]

    def _worse(self, pairs: Indices) -> Indices:
        """Return of pairs, all of their cells, those that lose more states than the best ones."""
        lost = self._lost(pairs, self.lp.cells, self.problem)
        least = np.full(self.lp.partition.size, np.iinfo(np.int64).max)
        np.minimum.at(least, pairs[:, 0], lost)
        return pairs[lost > least[pairs[:, 0]]]

    def _lost(self, pairs: Indices, cells: Indices, sampled: Problem) -> Indices:
        """Return how many of some states every pair sends out of cells and A, shape (D,)."""
        sets = self.transitions.sets
        allowed = np.zeros(self.lp.partition.size + 1, dtype=np.bool_)  # the last: nowhere
        allowed[cells] = allowed[:-1][sets.attractor] = True
        sampler = Sampler(sampled, self.lp.partition, None, sets)
        lost = np.zeros(len(pairs), dtype=np.int64)
        some = max(1, sampler.chunk // sampler.samples)
        for control in np.unique(pairs[:, 1]).tolist():
            every = np.flatnonzero(pairs[:, 1] == control)
            for at in np.split(every, range(some, len(every), some)):
                block = Block(0, pairs[at, 0], (control, control + 1))
                index = sampler.images(block, sampler.values(block)).reshape(-1, len(at))
                where = np.where(index >= 0, index, -1).astype(np.int64)
                lost[at] = (~allowed[where]).sum(axis=0)
        return lost


def _by_states(problem: Problem, partition: Partition, pairs: int) -> Problem:
    """Return the problem sampled by states, and nothing of it but motion and sets."""
    k = int((SAMPLES / max(pairs * node_count(problem), 1)) ** (1 / partition.dimension))
    k = min(max(k, FEWEST), MOST)
    plain = problem.replaced(
        stage_cost="0", cost_rate=None, terminal_cost=None, admissible=None,
        sampling={"kind": "grid", "per_axis": k},
    )  # fmt: skip
    return plain.model_copy(update={"sampling": States(per_axis=k)})
