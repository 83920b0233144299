"""The true map under a controller, step by step: runs to the attractor, and on inside it."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Indices, Statuses
from lmdsl.control.after_arrival import Held, goes_on
from lmdsl.control.controller import Controller, Interpolated, Law
from lmdsl.control.integration import Integrator
from lmdsl.control.steps import CompiledSteps, Drawn, Moved, Steps
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.forking import cached_property
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.local_control import HoldControl, absorbed_on_way
from lmdsl.problem.problem import Problem
from lmdsl.problem.whole.changing import with_parameters
from lmdsl.systems import DataSystem, MatrixSystem
from lmdsl.systems.matrices.system import Draws
from lmdsl.systems.named import NotStored

REACHED, LOST, CYCLING = 0, 1, 2
OUTCOMES = ("reached", "lost", "cycling")
LOSSES = ("outside", "avoid", "no_control")  # where runs are lost: of the box, or such a cell

FOREVER = Deadline()


class Runs(NamedTuple):
    """What became of runs.

    Attributes
    ----------
    outcome
        REACHED, LOST or CYCLING, shape (r,).
    taken
        Number of steps, shape (r,).
    loss
        Of the lost, an index of LOSSES, shape (r,).
    cost
        Sum over the steps of their costs, weighed by the powers of gamma (and of the discount),
        shape (r,).
    time
        How long they took, in steps: less than ``taken`` where the last one ended early.
    arrived
        States in which the runs that reached A entered it, in no particular order, shape (., d).
    power, dearest
        What the next step of the others would be weighed by, and the largest cost of a step.
    """

    outcome: Indices
    taken: Indices
    loss: Indices
    cost: Floats
    time: Floats
    arrived: Floats
    power: float
    dearest: float


class ClosedLoop:
    """The true map under a controller: wraps, clips and judges as the problem says.

    Of a finite model the next states are drawn by its rows, and are the centres of their cells.
    Differential equations are integrated accurately and judged all along their path, and noise is
    drawn from its distribution; :attr:`compiled` follows the compiled step and its noise nodes.

    ``declared`` is the problem that was solved, whose cells these are; :meth:`under` makes runs of
    one with other parameters.
    """

    def __init__(
        self,
        problem: Problem,
        controller: Controller | Interpolated,
        status: Statuses,
        as_compiled: bool = False,
        declared: Problem | None = None,
    ) -> None:
        self.problem, self.controller, self.status = problem, controller, status
        self.declared = declared or problem
        self.as_compiled, self.partition = as_compiled, controller.partition
        self.true_map = TrueMap(problem, self.partition)
        system = problem.system
        self.draws = Draws(system.rows) if isinstance(system, MatrixSystem) else None
        self.noise = Drawn(problem, as_compiled)
        self.weight = problem.gamma * (problem.discount or 1.0)
        paid = isinstance(system, MatrixSystem) and system.pays_all
        self._stage, self._terminal = None if paid else problem.stage(), problem.terminal()

    @property
    def holds(self) -> bool:
        """Whether there are controls on the attractor cells."""
        held = isinstance(self.problem.local_controller, HoldControl)
        return held or self.controller.local is not None

    @cached_property
    def compiled(self) -> "ClosedLoop":
        """The same by the compiled step and its noise nodes."""
        if self.as_compiled:
            return self
        return ClosedLoop(self.problem, self.controller, self.status, True, self.declared)

    def by(self, mode: Law) -> "ClosedLoop":
        """Return the same under a law of the controller; see :meth:`Controller.law`."""
        law = self.controller.law(mode)
        if law is self.controller:
            return self
        return ClosedLoop(self.problem, law, self.status, self.as_compiled, self.declared)

    def under(self, parameters: Mapping[str, float]) -> "ClosedLoop":
        """Return the same controller and cells with other parameters of the system."""
        problem = with_parameters(self.declared, parameters)
        return ClosedLoop(problem, self.controller, self.status, self.as_compiled, self.declared)

    @cached_property
    def steps(self) -> Steps:
        """What makes the steps."""
        if self.as_compiled or self.problem.flow() is None:
            return CompiledSteps(self.true_map, self.declared)
        return Integrator(self.true_map, self.status)

    @property
    def method(self) -> str:
        """What is followed, in words."""
        if self.draws is not None:
            return self.followed
        return "as compiled: " * self.as_compiled + self.steps.method

    @property
    def followed(self) -> str:
        """Whose runs these are: of data nothing but the recorded rows is known."""
        if self.draws is None:
            return "true map"
        return "recorded rows" if isinstance(self.problem.system, DataSystem) else "given rows"

    def step(
        self, x: Floats, cell: Indices, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> tuple[Floats, Indices]:
        """Return the next states, shape (r, d), and their cells, -1 outside the box.

        A path that enters A or avoid, or leaves the box, ends there.
        """
        moved = self.move(x, cell, rng, deadline)
        return moved.state, moved.cell

    def move(
        self,
        x: Floats,
        cell: Indices,
        rng: np.random.Generator,
        deadline: Deadline = FOREVER,
        absorb: bool = True,
        pieces: int = 0,
    ) -> Moved:
        """Make a step; see :meth:`Steps.move`. Its cost is without the terminal cost."""
        u, w = self.controller.at(cell, x), self.noise(rng, len(x))
        values = self.true_map.named(list(x.T), list(u.T), w)
        guard = partial(deadline.raise_if_over, "simulating")
        if self.draws is None:
            absorb = absorb and absorbed_on_way(self.problem.local_controller)
            moved = self.steps.move(values, guard, absorb, pieces)
        else:
            guard()
            index = np.where(cell >= 0, self.controller.index[cell], -1).astype(np.int64)
            after = self.draws(cell, index, rng)
            place = self.partition.centres(np.maximum(after, 0))
            moved = Moved(place, after, self.draws.costs(cell, index), np.zeros((0, *x.shape)))
        if self._stage is None:
            return moved
        given = 0.0 if self.draws is None else moved.cost
        try:
            (stage,) = self._stage(values, guard)
        except NotStored:  # only a saved result is at hand: the runs are known, their costs not
            stage = np.array(np.nan)
        return moved._replace(cost=given + np.broadcast_to(stage, len(x)))

    def run(
        self, x: Floats, steps: int, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> Runs:
        """Run from states until A, loss, the step limit, or the deadline."""
        x, cell = self.partition.enter(x)
        arrived = [x[:0]]
        outcome = np.full(len(x), CYCLING, dtype=np.int64)
        taken = np.full(len(x), steps, dtype=np.int64)
        loss, cost = np.zeros(len(x), dtype=np.int64), np.zeros(len(x))
        time = np.zeros(len(x))
        active, power, dearest = np.arange(len(x)), 1.0, 0.0
        for n in range(steps + 1):
            outcome[active], loss[active] = self.judged(cell)
            taken[active] = n
            ended = outcome[active] == REACHED
            arrived.append(x[ended])
            cost[active[ended]] += (power * self.paid(x[ended])) if n else 0.0
            on = outcome[active] == CYCLING
            active, x, cell = active[on], x[on], cell[on]
            if n == steps or not len(active) or deadline():
                break
            try:
                moved = self.move(x, cell, rng, deadline)
            except TimeLimitReached:
                break
            x, cell = moved.state, moved.cell
            with np.errstate(all="ignore"):
                cost[active] += power * moved.cost
                time[active] += moved.part
                power *= self.weight
                dearest = max(dearest, float(moved.cost.max()))
        return Runs(outcome, taken, loss, cost, time, np.concatenate(arrived), power, dearest)

    def judged(self, cell: Indices) -> tuple[Indices, Indices]:
        """Return what became of runs by their cells, and of the lost an index of LOSSES."""
        state = np.where(cell >= 0, self.status[cell], CellStatus.AVOID)
        ended = np.where(state == CellStatus.ATTRACTOR, REACHED, LOST)
        loss = np.where(cell < 0, 0, np.where(state == CellStatus.AVOID, 1, 2))
        return np.where(state == CellStatus.STABILIZED, CYCLING, ended), loss

    @property
    def step_time(self) -> float | None:
        """The time of a step; None of a map, which has none."""
        return getattr(self.problem.system, "step", None)

    def paid(self, x: Floats) -> Floats:
        """Return the terminal costs of states in A, shape (r,)."""
        system, missed = self.problem.system, 0.0
        if isinstance(system, MatrixSystem):
            missed = system.missed(self.problem.gamma, self.problem.discount)
        if self._terminal is None:
            return np.full(len(x), missed)
        named = dict(zip(self.partition.names, x.T, strict=True))
        return missed + np.broadcast_to(self._terminal(named)[0], len(x))

    def hold(
        self, x: Floats, steps: int, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> Held:
        """Run on from states of A, under the local controller inside A and the other outside."""
        if not self.holds:
            raise BadInput("the problem names no local controller", "local_controller")
        return goes_on(self, x, steps, rng, deadline)

    @own_arithmetic
    def path(self, x: ArrayLike, steps: int, seed: int = 0, *, as_compiled: bool = False) -> Floats:
        """Return the states of one run, shape (steps taken + 1, d), ending in A or with a loss."""
        if inputs.flag(as_compiled, "as_compiled") and not self.as_compiled:
            return self.compiled.path(x, steps, seed)
        start, steps = inputs.states(x, self.partition.names, "x"), inputs.whole(steps, "steps", 0)
        if start.size != self.partition.dimension or not np.isfinite(start).all():
            raise BadInput("a path starts in one state of finite numbers", "x")
        rng = np.random.default_rng(inputs.seed(seed))
        state, cell = self.partition.enter(start.reshape(1, -1))
        states = [state[0]]
        while len(states) <= steps and cell[0] >= 0 and self.status[cell[0]] == 1:
            state, cell = self.step(state, cell, rng)
            states.append(state[0])
        return np.array(states)


def draw_starts(
    partition: Partition, cells: Indices, weight: Floats, count: int, rng: np.random.Generator
) -> Floats:
    """Draw states by m: a cell by its weight, then uniform inside, shape (count, d)."""
    chosen = cells[rng.choice(len(cells), size=count, p=weight / weight.sum())]
    index = np.stack(partition.multi_index(chosen), axis=-1)
    return partition.low + (index + rng.random(index.shape)) * partition.width
