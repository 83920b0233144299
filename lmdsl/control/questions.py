"""What people ask of a controller in use: runs from anywhere, one path, what a state costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lmdsl.common import inputs
from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Statuses
from lmdsl.control.controller import Controller, Law
from lmdsl.control.loop import CYCLING, LOSSES, LOST, OUTCOMES, REACHED, ClosedLoop, draw_starts
from lmdsl.control.simulation import Simulation, simulate
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.systems.named import NotStored


@dataclass(frozen=True, eq=False)
class Trajectory(Frozen):
    """One run of the true map in closed loop.

    Attributes
    ----------
    states
        Where each step begins, and where the last one ends, shape (k + 1, d).
    controls
        The control of each step, shape (k, p).
    times
        When that is, shape (k + 1,): of an equation in its units of time, else in steps. An event
        may end the last step early.
    costs
        What each step costs, not weighed, without the terminal cost, shape (k,).
    cost
        Their sum by the powers of gamma (and of the discount), with the terminal cost.
    outcome
        ``reached``, ``lost``, or ``cycling``: neither within the steps asked for.
    lost_to
        Where it was lost: ``outside``, ``avoid`` or ``no_control``; None if it was not.
    """

    states: Floats
    controls: Floats
    times: Floats
    costs: Floats
    cost: float
    outcome: str
    lost_to: str | None

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.costs)

    def __repr__(self) -> str:
        word = f"{self.outcome}: {self.lost_to}" if self.lost_to else self.outcome
        return (
            f"Trajectory({len(self)} steps until {self.times[-1]:.6g}, cost {self.cost:.6g}, "
            f"{word})"
        )


class InUse:
    """What is asked of a controller in use; a result answers it."""

    problem: Problem
    partition: Partition
    control_index: NDArray[np.int32]
    control_vectors: Floats
    cell_status: Statuses
    value: Floats
    message: str

    @property
    def weight(self) -> Floats:
        """The user's m over all cells, shape (N,)."""
        raise NotImplementedError

    @cached_property
    def controller(self) -> Controller:
        """The feedback law, ``u = result.controller(x)``: the paper's C1, and C0 in A if any."""
        attractor = self.cell_status == CellStatus.ATTRACTOR
        try:
            local = LocalController.of(self.problem, self.partition, attractor)
        except NotStored:  # its linearisation needs the function; C1 does not
            local = None
        return Controller(self.partition, self.control_vectors, self.control_index, local)

    @cached_property
    def closed_loop(self) -> ClosedLoop:
        """The true map under the controller."""
        return ClosedLoop(self.problem, self.controller, self.cell_status)

    def _loop(self, as_compiled: Any, parameters: Any, mode: Law) -> ClosedLoop:
        """Return the loop to be followed."""
        if (self.control_index < 0).all():
            raise BadInput("there is no controller to simulate: " + self.message)
        loop = self.closed_loop.by(mode)
        if inputs.flag(as_compiled, "as_compiled"):
            loop = loop.compiled
        return loop if parameters is None else loop.under(parameters)

    @own_arithmetic
    def value_at(self, x: ArrayLike) -> Floats:
        """Return the proved upper bound V_up of the cost from states.

        Parameters
        ----------
        x
            Shape (..., d), or by name, as for the controller.

        Returns
        -------
        ndarray, shape (...)
            That of their cells: 0 on A, infinity outside the box, off C, and where no bound was
            established.
        """
        states = inputs.states(x, self.partition.names, "x")
        _, cell = self.partition.enter(states.reshape(-1, self.partition.dimension))
        found = np.where(cell >= 0, self.value[np.maximum(cell, 0)], np.inf)
        return found.reshape(states.shape[:-1])

    @own_arithmetic
    def simulate(
        self,
        starts: int | ArrayLike = 10_000,
        steps: int = 10_000,
        seed: int = 0,
        hold: int = 1_000,
        time_limit: float | None = None,
        *,
        as_compiled: bool = False,
        parameters: Mapping[str, float] | None = None,
        mode: Law = "constant",
    ) -> Simulation:
        """Run the true map under the controller from fresh random starts, or from given ones.

        Differential equations are integrated accurately and judged all along their path (unless
        the problem says ``endpoint``); noise is drawn from its distribution.

        Parameters
        ----------
        starts
            Number of runs, with starts drawn by m; or the states to start from, shape (r, d) or
            (d,), or by name as for the controller. Then ``each`` says what became of each.
        steps, seed
            Step limit of each run, seed of starts and noise.
        hold
            With a local controller, steps to run on after the first entry into A.
        time_limit
            Seconds; runs that have not ended by then count as cycling.
        as_compiled
            Follow the compiled Runge-Kutta steps, and the noise nodes with their weights, instead.
        parameters
            Other values of parameters of the system, by name: the controller and the cells stay,
            the map and its costs change.
        mode
            ``constant`` on cells, as certified, or ``interpolated``, as for the controller.

        Raises
        ------
        BadInput
            There is no controller, a count or the limit is not positive, states are not finite, or
            the system has no such parameter.
        """
        whole = np.ndim(starts) == 0 and not isinstance(starts, Mapping)
        x = None if whole else self._given(starts)
        count = inputs.whole(starts, "starts") if x is None else len(x)
        steps = inputs.whole(steps, "steps")
        hold, seed = inputs.whole(hold, "hold"), inputs.seed(seed)
        deadline = Deadline.of(time_limit)
        loop = self._loop(as_compiled, parameters, mode)
        # States, images and their cells, controls, noise, and the arrays of the formulas.
        wide, live = len(loop.true_map.names), loop.true_map.map.live
        memory.require(8 * count * (16 * wide + 12 + live), "runs")
        rng = np.random.default_rng(seed)
        if x is None:
            cells = np.flatnonzero(self.cell_status == CellStatus.STABILIZED)
            weight = self.weight[cells]
            if not len(cells) or not weight.any():
                raise BadInput("there is no stabilizable cell to start from")
            found = draw_starts(self.partition, cells, weight, count, rng)
            return simulate(loop, found, steps, rng, hold, deadline)
        return simulate(loop, x, steps, rng, hold, deadline, given=True)

    def _given(self, starts: Any) -> Floats:
        """Return the states to start from, shape (r, d)."""
        x = inputs.states(starts, self.partition.names, "starts")
        x = x.reshape(1, -1) if x.ndim == 1 else x
        if x.ndim != 2 or not len(x):
            raise BadInput(f"states to start from have shape (r, d), not {x.shape}", "starts")
        if not np.isfinite(x).all():
            raise BadInput("a state to start from is not finite", "starts")
        return x

    @own_arithmetic
    def path(
        self,
        x: ArrayLike,
        steps: int = 10_000,
        seed: int = 0,
        *,
        as_compiled: bool = False,
        parameters: Mapping[str, float] | None = None,
        mode: Law = "constant",
    ) -> Trajectory:
        """Follow one run of the true map until it enters A or is lost.

        Parameters
        ----------
        x
            The state to start from, shape (d,), or by name.
        steps
            Steps at most.
        seed, as_compiled, parameters, mode
            As for :meth:`simulate`.

        Raises
        ------
        BadInput
            As for :meth:`simulate`; also where x is more than one state.
        """
        start, steps = self._given(x), inputs.whole(steps, "steps", 0)
        if len(start) != 1:
            raise BadInput(f"a path starts in one state, not in {len(start)}", "x")
        loop = self._loop(as_compiled, parameters, mode)
        return follow(loop, start, steps, np.random.default_rng(inputs.seed(seed)))


def follow(loop: ClosedLoop, x: Floats, steps: int, rng: np.random.Generator) -> Trajectory:
    """Follow one run from a state, shape (1, d), until A, loss, or the number of steps."""
    x, cell = loop.partition.enter(x)
    states, times = [x[0]], [0.0]
    controls: list[Floats] = []
    costs: list[float] = []
    total, power = 0.0, 1.0
    step = loop.step_time or 1.0
    while len(costs) < steps and loop.judged(cell)[0][0] == CYCLING:
        controls.append(loop.controller.at(cell, x)[0])
        moved = loop.move(x, cell, rng)
        x, cell = moved.state, moved.cell
        states.append(x[0])
        costs.append(float(moved.cost[0]))
        part = float(np.broadcast_to(moved.part, 1)[0])
        times.append(step * (len(costs) - 1 + part))
        total += power * costs[-1]
        power *= loop.weight
    outcome, loss = (int(found[0]) for found in loop.judged(cell))
    if outcome == REACHED and costs:
        total += power * float(loop.paid(x)[0])
    return Trajectory(
        states=np.array(states),
        controls=np.array(controls).reshape(len(costs), loop.controller.vectors.shape[1]),
        times=np.array(times),
        costs=np.array(costs),
        cost=total,
        outcome=OUTCOMES[outcome],
        lost_to=LOSSES[loss] if outcome == LOST else None,
    )
