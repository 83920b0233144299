"""The true map in closed loop: runs, and what became of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lmdsl.common import inputs
from lmdsl.common.frozen import Frozen
from lmdsl.common.types import Floats, Indices
from lmdsl.control.controller import Controller
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.discretization import noise_nodes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.local_control import ConstantControl
from lmdsl.problem.problem import Problem

REACHED, LOST, CYCLING = 0, 1, 2

FOREVER = Deadline()

FEW = 0.01
"""Share of the runs that may miss the attractor before the samples are called too few."""


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


@dataclass(frozen=True, eq=False)
class Simulation(Frozen):
    """Outcome of closed-loop runs of the true map from fresh random starts.

    Attributes
    ----------
    starts
        Number of runs; starts are drawn by m (a cell, then uniform inside).
    reached, lost, cycling
        Runs that entered A; that left the box, entered avoid or a cell without control; that did
        neither within the step limit.
    steps
        ``min``, ``q50``, ``q90``, ``q99``, ``max`` of the steps of the reached; None if none.
    interval
        95 % Clopper-Pearson interval of the share reached.
    held
        What became of the reached under the local controller; None without one.
    steps_made
        Steps that were made: fewer than the limit where every run ended, or the time was up.
    cut
        The time was up: the runs that had not ended count as cycling.
    """

    starts: int
    reached: int
    lost: int
    cycling: int
    steps: dict[str, int] | None
    interval: tuple[float, float]
    held: Held | None = None
    steps_made: int = 0
    cut: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        data = {**asdict(self), "interval": list(self.interval)}
        if self.held is not None and self.held.distance is not None:
            data["held"]["distance"] = list(self.held.distance)
        return data

    def sentence(self) -> str:
        """Return what became of the runs, and what it means where many did not arrive."""
        parts = [f"true map: {self.reached:,} of {self.starts:,} runs arrive"]
        parts += [f"{self.lost:,} {'is' if self.lost == 1 else 'are'} lost"] * bool(self.lost)
        parts += [f"{self.cycling:,} cycle{'s'[self.cycling != 1 :]}"] * bool(self.cycling)
        text = ", ".join(parts)
        if self.cut:
            text += f" or are cut off after {self.steps_made:,} steps"
        usual = self.steps["q50"] if self.steps else self.steps_made
        underway = self.cut and self.steps_made < 10 * usual
        missed = self.lost + self.cycling * (not underway)
        return text + ": too few samples, or too large cells" * (missed > FEW * self.starts)

    def text(self) -> str:
        """Return a summary for people."""
        low, high = self.interval
        lines = [
            f"{self.starts} runs of the true map from random starts",
            f"  reached the attractor  {self.reached}  ({100 * self.reached / self.starts:.4g} %; "
            f"95 % interval {100 * low:.4g} to {100 * high:.4g} %)",
            f"  lost                   {self.lost}",
            f"  cycling                {self.cycling}",
        ]
        if self.cut:
            lines[-1] += f"  (or cut off by the time limit after {self.steps_made} steps)"
        if self.steps:
            steps = ", ".join(f"{k} {v}" for k, v in self.steps.items())
            lines.append(f"  steps                  {steps}")
        if self.held:
            held = self.held
            lines += [
                f"  then {held.steps} more steps under local controller and controller together",
                f"    stayed in the attractor  {held.stayed}",
                f"    left, and came back      {held.returned}",
                f"    left, on the way back    {held.away}",
                f"    left, and were lost      {held.lost}",
            ]
            if held.distance:
                lines.append(
                    f"    distance from the orbit  median {held.distance[0]:.3g}, "
                    f"max {held.distance[1]:.3g} cell widths"
                )
        return "\n".join(lines)

    __str__ = text


class ClosedLoop:
    """The true map under a controller: wraps, clips and judges like the compiled model."""

    def __init__(self, problem: Problem, controller: Controller, status: NDArray[np.uint8]) -> None:
        self.problem, self.controller, self.status = problem, controller, status
        self.partition = controller.partition
        self.true_map = TrueMap(problem, self.partition)
        self.nodes = noise_nodes(problem)
        self.probability = self.nodes.weights / self.nodes.weights.sum()

    def step(
        self, x: Floats, cell: Indices, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> tuple[Floats, Indices]:
        """Return the next states, shape (r, d), and their cells, -1 outside the box.

        Raises
        ------
        TimeLimitReached
            The deadline has passed.
        """
        u = self.controller.at(cell, x)
        noise: list[Floats] = []
        if self.problem.noises:
            node = rng.choice(len(self.probability), size=len(x), p=self.probability)
            noise = list(self.nodes.values[node].T)
        return self.true_map.step(x, u, noise, partial(deadline.raise_if_over, "simulating"))

    def run(
        self, x: Floats, steps: int, rng: np.random.Generator, deadline: Deadline = FOREVER
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Run from states until A, loss, the step limit, or the deadline.

        Returns
        -------
        outcome, taken
            Per run.
        arrived
            The states in which the runs that reached A entered it, in no particular order.
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


def simulate(
    loop: ClosedLoop,
    cells: Indices,
    weight: Floats,
    starts: int,
    steps: int,
    seed: int,
    hold: int,
    deadline: Deadline,
) -> Simulation:
    """Simulate closed-loop runs from random starts.

    Parameters
    ----------
    loop
        The true map under the controller.
    cells, weight
        The cells of C and m on them; starts are drawn by m.
    starts, steps, seed
        Number of runs, step limit, seed of starts and noise.
    hold
        Steps to run on after the first entry into A, where there is a local controller.
    deadline
        When to stop: the runs that have not ended by then count as cycling.
    """
    # States, images and their cells, controls, noise, and the arrays of the formulas.
    wide, live = len(loop.true_map.names), loop.true_map.map.live
    memory.require(8 * starts * (16 * wide + 12 + live), "runs")
    rng = np.random.default_rng(seed)
    if not len(cells) or not weight.any():
        raise BadInput("there is no stabilizable cell to start from")
    x = draw_starts(loop.partition, cells, weight, starts, rng)
    outcome, taken, arrived = loop.run(x, steps, rng, deadline)
    reached = int((outcome == REACHED).sum())
    made = int(taken.max())
    cycling = int((outcome == CYCLING).sum())
    quantiles = None
    if reached:
        q = np.quantile(taken[outcome == REACHED], [0, 0.5, 0.9, 0.99, 1], method="inverted_cdf")
        quantiles = dict(zip(("min", "q50", "q90", "q99", "max"), map(int, q), strict=True))
    return Simulation(
        starts=starts,
        reached=reached,
        lost=int((outcome == LOST).sum()),
        cycling=cycling,
        steps=quantiles,
        interval=clopper_pearson(reached, starts),
        held=None if loop.controller.local is None else loop.hold(arrived, hold, rng, deadline),
        steps_made=made,
        cut=bool(cycling) and made < steps,
    )


def clopper_pearson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact two-sided confidence interval of a binomial probability."""
    from scipy.special import betaincinv

    tail = (1 - level) / 2
    low = float(betaincinv(hits, trials - hits + 1, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1, trials - hits, 1 - tail)) if hits < trials else 1.0
    return low, high
