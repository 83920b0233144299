"""The true map under a controller, step by step: runs to the attractor, and on inside it."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Indices, Statuses
from lmdsl.control.controller import Controller
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.discretization import noise_nodes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.local_control import ConstantControl
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem
from lmdsl.systems.matrices.system import Draws

REACHED, LOST, CYCLING = 0, 1, 2


FOREVER = Deadline()


@dataclass(frozen=True)
class Held:
    """What became of the runs that reached A, under local controller and controller together.

    Attributes
    ----------
    steps
        Steps each run went on after its first entry into A.
    stayed, returned, away, lost
        Runs that never left A; that left it and are back at the end; that are underway at the
        end; that were lost.
    distance
        Median and largest distance from the orbit at the end, in cell widths, of the runs in A;
        None where there is no orbit, or no run.
    """

    steps: int
    stayed: int
    returned: int
    away: int
    lost: int
    distance: tuple[float, float] | None


class ClosedLoop:
    """The true map under a controller: wraps, clips and judges like the compiled model.

    Of a finite model the next states are drawn by its rows, and are the centres of their cells.
    """

    def __init__(self, problem: Problem, controller: Controller, status: Statuses) -> None:
        self.problem, self.controller, self.status = problem, controller, status
        self.partition = controller.partition
        self.true_map = TrueMap(problem, self.partition)
        self.nodes = noise_nodes(problem)
        system = problem.system
        self.draws = Draws(system.rows) if isinstance(system, MatrixSystem) else None
        self.probability = self.nodes.weights / self.nodes.weights.sum()

    def step(
        self, x: Floats, cell: Indices, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> tuple[Floats, Indices]:
        """Return the next states, shape (r, d), and their cells, -1 outside the box."""
        if self.draws is not None:
            deadline.raise_if_over("simulating")
            index = self.controller.index[cell].astype(np.int64)
            after = self.draws(cell, np.where(cell >= 0, index, -1), rng)
            return self.partition.centres(np.maximum(after, 0)), after
        u = self.controller.at(cell, x)
        noise: list[Floats] = []
        if self.problem.noises:
            node = rng.choice(len(self.probability), size=len(x), p=self.probability)
            noise = list(self.nodes.values[node].T)
        return self.true_map.step(x, u, noise, partial(deadline.raise_if_over, "simulating"))

    def run(
        self, x: Floats, steps: int, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> tuple[Indices, Indices, Floats]:
        """Run from states until A, loss, the step limit, or the deadline.

        Returns outcome and number of steps of each run, and the states, in no particular order, in
        which the runs that reached A entered it.
        """
        x, cell = self.partition.enter(x)
        arrived = [x[:0]]
        outcome = np.full(len(x), CYCLING, dtype=np.int64)
        taken = np.full(len(x), steps, dtype=np.int64)
        active = np.arange(len(x))
        for n in range(steps + 1):
            state = np.where(cell >= 0, self.status[cell], CellStatus.AVOID)
            for code, ended in (
                (REACHED, state == CellStatus.ATTRACTOR),
                (LOST, state > CellStatus.STABILIZED),
            ):
                outcome[active[ended]] = code
                taken[active[ended]] = n
                if code == REACHED:
                    arrived.append(x[ended])
            on = state == CellStatus.STABILIZED
            active, x, cell = active[on], x[on], cell[on]
            taken[active] = n
            if n == steps or not len(active) or deadline():
                break
            try:
                x, cell = self.step(x, cell, rng, deadline)
            except TimeLimitReached:
                break
        return outcome, taken, np.concatenate(arrived)

    def hold(
        self, x: Floats, steps: int, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> Held:
        """Run on from states of A, under the local controller inside A and the other outside."""
        local = self.controller.local
        if local is None:
            raise BadInput("the problem names no local controller", "local_controller")
        (x, cell), runs = self.partition.enter(x), len(x)
        stayed = np.ones(runs, dtype=np.bool_)
        for n in range(steps):
            try:
                x, cell = self.step(x, cell, rng, deadline)
            except TimeLimitReached:
                steps = n
                break
            state = np.where(cell >= 0, self.status[cell], CellStatus.AVOID)
            on = state <= CellStatus.STABILIZED
            stayed = (stayed & (state == CellStatus.ATTRACTOR))[on]
            x, cell = x[on], cell[on]
            if not len(x):
                break
        inside = self.status[cell] == CellStatus.ATTRACTOR
        distance = None
        constant = isinstance(self.problem.local_controller, ConstantControl)
        if inside.any() and not constant:
            away = local.distance(x[inside])
            distance = (float(np.median(away)), float(away.max()))
        return Held(
            steps=steps,
            stayed=int(stayed.sum()),
            returned=int((inside & ~stayed).sum()),
            away=int((~inside).sum()),
            lost=runs - len(x),
            distance=distance,
        )

    @own_arithmetic
    def path(self, x: ArrayLike, steps: int, seed: int = 0) -> Floats:
        """Return the states of one run, shape (steps taken + 1, d), ending in A or with a loss."""
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
