"""How exactly the Runge-Kutta steps integrate a cost rate, at samples whose path is no escape."""

from collections.abc import Mapping

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.machine.forking import cached_property
from lmdsl.model.assembly.paths.judging import PathJudge
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem
from lmdsl.systems.runge_kutta import RungeKutta


def relative(found: Floats, exact: Floats) -> float:
    """Return the difference of costs, in all, in parts of the costs; infinite where not finite.

    Not the error of each: a cost near 0 is of no account, and a rare one that is enormous is.
    """
    with np.errstate(all="ignore"):
        apart, whole = np.abs(found - exact).sum(), np.abs(exact).sum()
        share = 0.0 if apart == 0 else float(apart / whole)
    return share if np.isfinite(share) else np.inf


class Quadrature:
    """The integrals of a cost rate at samples, given by (r,) arrays, by so many substeps."""

    def __init__(
        self,
        problem: Problem,
        partition: Partition,
        sets: CellSets,
        values: Mapping[str, Floats],
        guard: Guard,
        substeps: int,
    ) -> None:
        self.problem, self.partition, self.sets = problem, partition, sets
        self.values, self.guard = values, guard
        flow = problem.flow()
        assert flow is not None
        self.flow, self.count = flow, substeps
        ends = self._judge(self.count)(values, (len(next(iter(values.values()))),), guard, False)
        inside = np.flatnonzero(ends.cell >= 0)
        inside = inside[sets.number[ends.cell[inside].astype(np.int64)] >= 0]
        self.rows = inside[~np.isnan(ends.integral[inside])]  # others are refused, not wrong
        self.time, self.integral = ends.time[self.rows], ends.integral[self.rows]

    def _judge(self, substeps: int) -> PathJudge:
        step = self.flow.h * self.flow.substeps
        flow = RungeKutta(self.flow.field, self.flow.states, step, substeps)
        endpoint = self.problem.judged == "endpoint"
        absorb = absorbed_on_way(self.problem.local_controller)
        return PathJudge(flow, self.partition, self.sets, endpoint, absorb)

    @cached_property
    def halving(self) -> float:
        """Relative difference to twice as many substeps, until the same times; 0 of no sample."""
        if not len(self.rows):
            return 0.0
        held = {name: x[self.rows] for name, x in self.values.items()}
        return relative(
            self.integral, self._judge(2 * self.count).until(held, 2 * self.time, self.guard)
        )
