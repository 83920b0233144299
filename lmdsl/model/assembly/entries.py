"""Where samples end and what they cost, where that takes more than their images.

Differential equations are judged along their path, a cost rate is integrated until the attractor
is entered, and a terminal cost is paid there.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Self

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.model.assembly.paths.judging import Endings, PathJudge, path_doubles
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem
from lmdsl.systems.runge_kutta import RungeKutta


def integrated(problem: Problem) -> RungeKutta | None:
    """Return what integrates a problem's equation, and its cost rate; None where images say all."""
    if problem.judged == "endpoint" and problem.cost_rate is None:
        return None
    return problem.flow()


def doubles(problem: Problem) -> int:
    """Return how many doubles a sample takes whose path is kept."""
    flow = integrated(problem)
    return 0 if flow is None else path_doubles(flow)


class Entries:
    """The end and the cost of samples; it may be called from several threads at once."""

    def __init__(self, problem: Problem, partition: Partition, sets: CellSets) -> None:
        self.partition, self.sets = partition, sets
        flow, self.terminal = integrated(problem), problem.terminal()
        endpoint = problem.judged == "endpoint"
        absorb = absorbed_on_way(problem.local_controller)
        self.path = None if flow is None else PathJudge(flow, partition, sets, endpoint, absorb)
        self.factor = problem.gamma * (1.0 if problem.discount is None else problem.discount)

    @classmethod
    def of(cls, problem: Problem, partition: Partition, sets: CellSets | None) -> Self | None:
        """Return what judges the samples of a problem; None where their images say all."""
        if integrated(problem) is None and problem.terminal_cost is None:
            return None
        return cls(problem, partition, sets or CellSets.of(problem, partition))

    def ends(
        self,
        values: Mapping[str, Floats],
        images: Callable[[Mapping[str, Floats]], Sequence[Floats]],
        shape: tuple[int, ...],
        guard: Guard,
        places: bool = False,
    ) -> Endings:
        """Return where samples end, given as named arrays that broadcast to ``shape``."""
        if self.path is not None:
            return self.path(values, shape, guard, places or self.terminal is not None)
        found = images(values)
        place = np.stack([np.broadcast_to(image, shape).ravel() for image in found])
        index = np.broadcast_to(self.partition.index(found), shape)
        return Endings(np.ascontiguousarray(index), place, np.empty(0), np.empty(0))

    def costs(self, ends: Endings, guard: Guard) -> dict[str, Floats]:
        """Return by key what samples pay besides a stage cost, in their shape.

        Of the terminal cost it is the formula's value, by which ``factor`` is to be multiplied.
        """
        costs: dict[str, Floats] = {}
        shape = ends.cell.shape
        if len(ends.integral):
            costs["cost_rate"] = ends.integral.reshape(shape)
        if self.terminal is not None:
            index = ends.cell.ravel()
            inside = np.flatnonzero(index >= 0)
            self.sets.meet(index)
            number = self.sets.number[index[inside].astype(np.int64)]
            absorbed = inside[number == len(self.sets.free)]
            states = self.partition.states(ends.place[:, absorbed].T)
            named = dict(zip(self.partition.names, states.T, strict=True))
            paid = np.zeros(index.shape)
            paid[absorbed] = self.terminal(named, guard)[0]
            costs["terminal_cost"] = paid.reshape(shape)
        return costs
